"""Rigs in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.rig.live import LiveRig


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., LiveRig]]:
    """Open a rig; one after another they share folder and clock. What is still open at the end is closed."""
    made: list[LiveRig] = []

    def of(kind: type[LiveRig] = LiveRig, **more: Any) -> LiveRig:
        clock = made[-1].clock if made else None
        made.append(kind(tmp_path, monkeypatch, **{"clock": clock, **more}))
        return made[-1]

    yield of
    for live in made:
        live.close()


@pytest.fixture
def live(make: Callable[..., LiveRig]) -> LiveRig:
    """One that is ready."""
    return make()
