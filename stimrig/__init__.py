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
    from stimrig import cohort
    from stimrig.api.charts.plot import plot
    from stimrig.api.cli.files import save
    from stimrig.api.client.rest import Client
    from stimrig.api.schemas import load as schema
    from stimrig.identify import Model, Record, compare, next_experiment, predict, read
    from stimrig.identify.effects import library as effects
    from stimrig.identify.tracking import track
    from stimrig.progress import carry, diagnose, explain, fit, improve
    from stimrig.verbs import emulate, export, invert, join, recover, table1

_PLACES = {
    "read": ("stimrig.identify.records", "read"),
    "Record": ("stimrig.identify.records.record", "Record"),
    "Model": ("stimrig.identify.model", "Model"),
    "predict": ("stimrig.identify.simulation.predict", "predict"),
    "compare": ("stimrig.identify.criticism", "compare"),
    "next_experiment": ("stimrig.identify.diagnosis", "next_experiment"),
    "track": ("stimrig.identify.tracking", "track"),
    "effects": ("stimrig.identify.effects", "library"),
    "schema": ("stimrig.api.schemas", "load"),
    "plot": ("stimrig.api.charts.plot", "plot"),
    "save": ("stimrig.api.cli.files", "save"),
    "Client": ("stimrig.api.client.rest", "Client"),
    **{name: ("stimrig.progress", name) for name in ("carry", "diagnose", "explain", "fit", "improve")},
    **{name: ("stimrig.verbs", name)
       for name in ("emulate", "export", "invert", "join", "recover", "table1")},
}  # fmt: skip

__all__ = [
    "Client", "Model", "Record", "carry", "cohort", "compare", "diagnose", "effects", "emulate", "errors", "explain",
    "export", "fit", "improve", "invert", "join", "next_experiment", "plot", "predict", "read",
    "recover", "save", "schema", "table1", "track",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "cohort":
        return import_module("stimrig.cohort")
    if name not in _PLACES:
        raise AttributeError(f"module 'stimrig' has no attribute {name!r}")
    module, attribute = _PLACES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__


def _draw(result: Any, record: Any) -> Any:
    """What `model.plot(record)` calls; the plotting library is loaded by the first figure."""
    return import_module("stimrig.api.charts.plot").plot(result, record)


register_plotter(_draw)
