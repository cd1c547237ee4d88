"""Faults by name, switched on and off at any moment.

A fault is a function marked `@fault` in any file of this folder. It takes the target and, by keyword, its settings
with their defaults. It makes the fault happen and returns a function that undoes it. Its name is the fault's name.

One marked `@hook(place)` returns a hook instead, which stands at that place while the fault is on. With
`@hook(name=place, other_name=other_place)` it is a fault of these names.
"""

from __future__ import annotations

import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from stimrig.hardware_sim.errors import HardwareSimError

Undo = Callable[[], None]
Make = TypeVar("Make", bound=Callable[..., Any])
Target = Any
"""The emulated devices (`Devices`); their `random` gives every random number that a fault needs."""
_FAULTS: dict[str, Callable[..., Undo]] = {}


Place = Callable[[Target], list[Any]]
"""The hooks of a target at one place."""


def fault(make: Make) -> Make:
    """Register a fault under its function's name."""
    _FAULTS[make.__name__] = make
    return make


def hook(place: Place | None = None, **places: Place) -> Callable[[Make], Make]:
    """Register faults that are a hook at a place."""

    def register(make: Make) -> Make:
        for name, where in ({make.__name__: place} if place else places).items():
            at = lambda target, where=where, **settings: hooked(make(target, **settings), where(target))  # noqa: E731
            _FAULTS[name] = wraps(make)(at)
        return make

    return register


def library() -> dict[str, Callable[..., Undo]]:
    """All faults, by name."""
    for entry in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{entry.name}")
    return dict(sorted(_FAULTS.items()))


def hooked(function: Any, *places: list[Any]) -> Undo:
    """Add a function to the hooks at these places; the result removes it."""
    for hooks in places:
        hooks.append(function)

    def unhook() -> None:
        for hooks in places:
            hooks.remove(function)

    return unhook


def replaced(owner: object, attribute: str, value: object) -> Undo:
    """Set an attribute of `owner`; the result sets it back."""
    before = getattr(owner, attribute)
    setattr(owner, attribute, value)
    return lambda: setattr(owner, attribute, before)


def check_not_negative(setting: str, value: float) -> None:
    """Refuse a setting of a fault that is no number from 0 on."""
    if not 0 <= value < math.inf:
        raise HardwareSimError(f"setting '{setting}' must be a number from 0 on, not {value:g}")


class Faults:
    """Faults of one target that are on, and the calls that undo them."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._library = library()
        self._on: dict[str, Undo] = {}

    def active(self) -> list[str]:
        """Names of the faults that are on."""
        return sorted(self._on)

    def describe(self) -> dict[str, Any]:
        """Each fault's first line of documentation and its settings with their defaults."""
        return {
            name: {"what": (make.__doc__ or "").split("\n")[0], "settings": _settings(make)}
            for name, make in self._library.items()
        }

    def on(self, name: str, settings: dict[str, Any], for_s: float | None = None) -> None:
        """Switch a fault on, for `for_s` emulated seconds or until it is switched off.

        Raises HardwareSimError: no such fault, or no such setting, or a setting of another type than its default.
        """
        known = _settings(self._find(name))
        for key, value in settings.items():
            if key not in known:
                raise HardwareSimError(f"fault '{name}' has no setting '{key}'; it has {', '.join(known) or 'none'}")
            if not isinstance(value, int | float) or isinstance(known[key], bool) != isinstance(value, bool):
                raise HardwareSimError(f"setting '{key}' of fault '{name}' must be like {known[key]!r}, not {value!r}")
        self.off(name)
        try:
            undo = self._on[name] = self._library[name](self._target, **settings)
        except HardwareSimError as error:
            raise HardwareSimError(f"fault '{name}': {error}") from None
        if for_s is not None:
            self._target.timeline.after(for_s, lambda: self._end(name, undo))

    def off(self, name: str) -> None:
        """Switch a fault off; nothing happens if it is off already. Raises HardwareSimError: no such fault."""
        self._find(name)
        if undo := self._on.pop(name, None):
            undo()

    def _end(self, name: str, undo: Undo) -> None:
        if self._on.get(name) is undo:  # otherwise it was switched on again in the meantime
            self.off(name)

    def _find(self, name: str) -> Callable[..., Undo]:
        if name not in self._library:
            raise HardwareSimError(f"unknown fault '{name}'; there are {', '.join(self._library)}")
        return self._library[name]


def _settings(make: Callable[..., Undo]) -> dict[str, Any]:
    parameters = list(inspect.signature(make).parameters.values())[1:]
    return {parameter.name: parameter.default for parameter in parameters}
