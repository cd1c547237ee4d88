"""Identify an electrically stimulated muscle, see where the model fails, learn what is missing.

    import stimrig

    record = stimrig.read("first.h5")
    model = stimrig.fit(record)
    model.plot(record)

docs/python.md shows every name. Names are loaded when they are first used, so that `import stimrig` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from stimrig import errors
from stimrig.identify.summary import register_plotter

if TYPE_CHECKING:
    from stimrig import cohort, identify
    from stimrig.api.charts.plot import plot
    from stimrig.api.cli.files import save
    from stimrig.api.client.rest import Client
    from stimrig.api.schemas import load as schema
    from stimrig.identify import Model, Record, compare, next_experiment, predict, read
    from stimrig.identify.effects import library as effects
    from stimrig.identify.tracking import track
    from stimrig.progress import with_bar
    from stimrig.verbs import emulate, invert, join, table1

    carry, diagnose, explain = with_bar(identify.carry), with_bar(identify.diagnose), with_bar(identify.explain)
    fit, improve = with_bar(identify.fit), with_bar(identify.improve)

_PLACES = {
    **dict.fromkeys(("Model", "Record", "compare", "next_experiment", "predict", "read"), "stimrig.identify"),
    **dict.fromkeys(("emulate", "invert", "join", "table1"), "stimrig.verbs"),
    "Client": "stimrig.api.client.rest",
    "effects": "stimrig.identify.effects:library",
    "plot": "stimrig.api.charts.plot",
    "save": "stimrig.api.cli.files",
    "schema": "stimrig.api.schemas:load",
    "track": "stimrig.identify.tracking",
}
_WITH_BAR = ("carry", "diagnose", "explain", "fit", "improve")

__all__ = [
    "Client", "Model", "Record", "carry", "cohort", "compare", "diagnose", "effects", "emulate", "errors",
    "explain", "fit", "improve", "invert", "join", "next_experiment", "plot", "predict", "read", "save", "schema",
    "table1", "track",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "cohort":
        return import_module("stimrig.cohort")
    if name in _WITH_BAR:
        bar = import_module("stimrig.progress").with_bar
        return globals().setdefault(name, bar(getattr(import_module("stimrig.identify"), name)))
    if name not in _PLACES:
        raise AttributeError(f"module 'stimrig' has no attribute {name!r}")
    module, _, attribute = _PLACES[name].partition(":")
    return getattr(import_module(module), attribute or name)


def __dir__() -> list[str]:
    return __all__


# What `model.plot(record)` calls; the plotting library is loaded by the first figure.
register_plotter(lambda result, record: import_module("stimrig.api.charts.plot").plot(result, record))
