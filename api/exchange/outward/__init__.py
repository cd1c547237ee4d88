"""Formats of `stimrig export`: each module is a `Writer` (`stimrig.api.cohort.export`) and is found by its file's name.

A module says in `NEEDS` which packages it needs beside those of `stimrig[cohort]`; they come with `stimrig[files]`.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from typing import Any

NAMES = sorted(info.name for info in pkgutil.iter_modules(__path__) if not info.name.startswith("_"))


def writer(name: str) -> Any:
    """The format of a name. Raises LookupError: there is none; ImportError: a package is missing, with its extra."""
    if name not in NAMES:
        raise LookupError(f"no format is called {name!r}. Give one of {', '.join(NAMES)}.")
    module = importlib.import_module(f"{__name__}.{name}")
    missing = [one for one in getattr(module, "NEEDS", ()) if importlib.util.find_spec(one) is None]
    if missing:
        raise ImportError(f"{name} needs `pip install stimrig[files]` ({', '.join(missing)} is missing)")
    return module
