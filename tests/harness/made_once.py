"""What is dear to make, as a fit or a diagnosis: made once for all processes of a run of the tests."""

from __future__ import annotations

import fcntl
import hashlib
import pickle
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
folder: Path | None = None
"""Where it is kept, of this run of the tests alone (`tests/conftest.py`); none: each process makes its own."""


def made_once(make: Callable[P, R]) -> Callable[P, R]:
    """A function whose result is kept in memory, and in a file for the other processes: no test may change it.

    Its arguments are words and numbers. Whoever comes while another process makes it waits for that one.
    """

    @cache
    @wraps(make)
    def made(*arguments: P.args, **options: P.kwargs) -> R:
        if folder is None:
            return make(*arguments, **options)
        name = hashlib.sha256(repr((make.__module__, make.__qualname__, arguments, options)).encode()).hexdigest()
        with (folder / f"{name[:24]}.pickle").open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # until the file is closed
            file.seek(0)
            if held := file.read():
                return pickle.loads(held)
            found = make(*arguments, **options)
            file.write(pickle.dumps(found))
            return found

    return made
