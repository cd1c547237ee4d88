"""Identification methods: one file each, found in this folder.

The module of a method has a variable `METHOD`, an object that satisfies `Method`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.errors import BadRequest
from stimrig.identify.model import Model


@runtime_checkable
class Method(Protocol):
    """A method that estimates a Hammerstein model from a record.

    Attributes
    ----------
    id : str
        As users write it: `two-stage`.
    summary : str
        One line.
    options : mapping of str to str
        Each option's name and what it does.
    """

    @property
    def id(self) -> str: ...

    @property
    def summary(self) -> str: ...

    @property
    def options(self) -> Mapping[str, str]: ...

    def fit(self, grid: Grid, fit_on: tuple[str, ...] | None, **options: Any) -> Model:
        """Fit a model to the grid's record; `fit_on` names the segments to use."""
        ...


@cache
def methods() -> dict[str, Method]:
    """Every method by its id."""
    found: dict[str, Method] = {}
    for info in pkgutil.iter_modules(__path__):
        method = getattr(import_module(f"{__name__}.{info.name}"), "METHOD", None)
        if isinstance(method, Method):
            found[method.id] = method
    return dict(sorted(found.items()))


def method_of(name: str) -> Method:
    """The method with this id. If its file has the same name, no other method is imported.

    Raises
    ------
    BadRequest
        No method has this id.
    """
    own = name.replace("-", "_")
    if own.isidentifier() and any(info.name == own for info in pkgutil.iter_modules(__path__)):
        found = getattr(import_module(f"{__name__}.{own}"), "METHOD", None)
        if isinstance(found, Method) and found.id == name:
            return found
    if name not in methods():
        raise BadRequest(f"unknown method {name!r}", place="method", fix=f"Known: {', '.join(methods())}.")
    return methods()[name]


def check_options(chosen: Method, options: Mapping[str, Any]) -> None:
    """Refuse options that a method does not have.

    Raises BadRequest: with the name of the option, and the known ones.
    """
    for name in options:
        if name not in chosen.options:
            known = ", ".join(chosen.options) or "none"
            raise BadRequest(f"unknown option {name!r} of {chosen.id}", place=name, fix=f"Known: {known}.")
