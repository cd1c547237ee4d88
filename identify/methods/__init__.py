"""Identification methods: one file each, found in this folder.

The module of a method has a variable `METHOD`, a `Method`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

from stimrig.identify.errors import BadRequest
from stimrig.identify.model import Model


@dataclass(frozen=True)
class Method:
    """A method that estimates a Hammerstein model from a record.

    `fit(grid, fit_on, **options)` fits a model to the grid's record; `fit_on` names the segments to use, or is None.
    """

    id: str  # as users write it: `two-stage`
    summary: str  # one line
    options: Mapping[str, str]  # each option's name and what it does
    fit: Callable[..., Model]  # the function that fits

    def check_options(self, options: Mapping[str, Any]) -> None:
        """Refuse options that the method does not have. Raises BadRequest: with the name, and the known ones."""
        for name in options:
            if name not in self.options:
                known = ", ".join(self.options) or "none"
                raise BadRequest(f"unknown option {name!r} of {self.id}", place=name, fix=f"Known: {known}.")


@cache
def methods() -> dict[str, Method]:
    """Every method by its id."""
    modules = [import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    listed = [module.METHOD for module in modules if isinstance(getattr(module, "METHOD", None), Method)]
    return {method.id: method for method in sorted(listed, key=lambda method: method.id)}


def method_of(name: str) -> Method:
    """The method with this id. Raises BadRequest: no method has this id.

    Parameters
    ----------
    name : str
        Id of a method.
    """
    if name not in methods():
        raise BadRequest(f"unknown method {name!r}", place="method", fix=f"Known: {', '.join(methods())}.")
    return methods()[name]
