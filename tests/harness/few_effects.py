"""A small library of effects, for tests of verbs and pages that show whatever a diagnosis finds."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from unittest import mock

from stimrig.identify import effects


@contextlib.contextmanager
def only(*names: str) -> Iterator[None]:
    """In this process the library holds these effects alone."""
    kept = [effects.find_effect(name) for name in names]
    try:
        with mock.patch.object(effects, "_library", lambda: kept):
            effects._everything.cache_clear()
            yield
    finally:
        effects._everything.cache_clear()
