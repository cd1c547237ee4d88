"""Finding the modules of a package, so that a new device or patient is one new file."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from stimrig.hardware_sim.errors import SettingsError


def modules_with(package: ModuleType, attribute: str) -> dict[str, ModuleType]:
    """Modules of `package` that themselves define the class `attribute`, by file name."""
    found = {}
    for entry in sorted(pkgutil.iter_modules(package.__path__), key=lambda entry: entry.name):
        module = importlib.import_module(f"{package.__name__}.{entry.name}")
        owner = getattr(getattr(module, attribute, None), "__module__", None)
        if owner == module.__name__:
            found[entry.name] = module
    return found


def pick(package: ModuleType, attribute: str, name: str, kind: str) -> type:
    """The class `attribute` of the module `name`.

    Raises
    ------
    SettingsError
        There is no such module; the message lists all.
    """
    found = modules_with(package, attribute)
    if name not in found:
        raise SettingsError(f"unknown {kind} '{name}'; there are {', '.join(found)}")
    return getattr(found[name], attribute)
