"""Faults by name, switched on and off at any moment.

A fault is a function marked `@fault`. It takes the target and, by keyword, its settings with their defaults.
It makes the fault happen and returns a function that undoes it. The function's name is the fault's name.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from typing import Any, TypeVar

from stimrig.hardware_sim import faults
from stimrig.hardware_sim.errors import FaultError
from stimrig.hardware_sim.faults.target import Target

Undo = Callable[[], None]
Make = TypeVar("Make", bound=Callable[..., Undo])
Hook = TypeVar("Hook")
_FAULTS: dict[str, Callable[..., Undo]] = {}


def fault(make: Make) -> Make:
    """Register a fault under its function's name."""
    _FAULTS[make.__name__] = make
    return make


def library() -> dict[str, Callable[..., Undo]]:
    """All faults, by name."""
    for entry in pkgutil.iter_modules(faults.__path__):
        importlib.import_module(f"{faults.__name__}.{entry.name}")
    return dict(sorted(_FAULTS.items()))


def hooked(hooks: list[Hook], hook: Hook) -> Undo:
    """Add `hook` to `hooks`; the result removes it."""
    hooks.append(hook)
    return lambda: hooks.remove(hook)


def replaced(owner: object, attribute: str, value: object) -> Undo:
    """Set an attribute of `owner`; the result sets it back."""
    before = getattr(owner, attribute)
    setattr(owner, attribute, value)
    return lambda: setattr(owner, attribute, before)


class Faults:
    """Which faults of one target are on, and what undoes them."""

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

        Raises
        ------
        FaultError
            No such fault, or no such setting, or a setting of another type than its default.
        """
        make = self._find(name)
        known = _settings(make)
        for key, value in settings.items():
            if key not in known:
                raise FaultError(f"fault '{name}' has no setting '{key}'; it has {', '.join(known) or 'none'}")
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if isinstance(known[key], bool) != isinstance(value, bool) or not (number or isinstance(value, bool)):
                raise FaultError(f"setting '{key}' of fault '{name}' must be like {known[key]!r}, not {value!r}")
        if name in self._on:
            self.off(name)
        undo = make(self._target, **settings)
        self._on[name] = undo
        if for_s is not None:
            self._target.timeline.after(for_s, lambda: self._end(name, undo))

    def off(self, name: str) -> None:
        """Switch a fault off; nothing happens if it is off already.

        Raises
        ------
        FaultError
            No such fault.
        """
        self._find(name)
        undo = self._on.pop(name, None)
        if undo is not None:
            undo()

    def _end(self, name: str, undo: Undo) -> None:
        if self._on.get(name) is undo:  # otherwise it was switched on again in the meantime
            self.off(name)

    def _find(self, name: str) -> Callable[..., Undo]:
        if name not in self._library:
            raise FaultError(f"unknown fault '{name}'; there are {', '.join(self._library)}")
        return self._library[name]


def _settings(make: Callable[..., Undo]) -> dict[str, Any]:
    parameters = list(inspect.signature(make).parameters.values())[1:]
    return {parameter.name: parameter.default for parameter in parameters}
