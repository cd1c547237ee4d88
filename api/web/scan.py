"""Routes and pages are found by scanning their folders: a new file is a new subject."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from fastapi import APIRouter


def routers(*packages: ModuleType) -> list[APIRouter]:
    """The routers of all files in these packages that have one, by name."""
    names = [f"{one.__name__}.{info.name}" for one in packages for info in sorted(pkgutil.iter_modules(one.__path__))]
    return [module.router for name in names if hasattr(module := importlib.import_module(name), "router")]
