"""A hidden effect over serial line and CAN bus: test, compare, diagnose, next experiment, add, reveal."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.hidden_on_the_wire import NOISE_LIKE, reveal, run

FIRST_SEED = 1000


def seed_by_what_it_hides() -> int:
    """The first from 1000 on that hides one effect of the library, of middle or full strength; not what works."""
    seed = FIRST_SEED
    while True:
        truth = reveal(seed)
        if len(truth["effects"]) == 1 and not truth["outside_library"] and truth["strength"] != "weak":
            return seed
        seed += 1


@pytest.mark.wire
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.xfail(
    reason="seed 1000 (series_compliance): named second after voluntary_effort; error falls from 13.5 to 8.4 x noise",
    strict=False,
)
def test_hidden_effect_is_named_added_and_the_error_falls_to_the_noise(tmp_path: Path) -> None:
    found = run(seed_by_what_it_hides(), 4.0, tmp_path)
    assert found["agrees"], found
    assert found["steps"][-1]["times_noise"] <= NOISE_LIKE, found["times_noise"]
