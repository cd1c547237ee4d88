"""A part of what is frozen at each run of the tests; `make frozen` compares all of it."""

from __future__ import annotations

import pytest

from tests.frozen.parts import HERE, PARTS, compare

PARTS_HERE = ("rest", "fitted/plain_short", "fitted/rig_stopped")


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS_HERE)
def test_what_users_hold_is_as_it_was(part: str) -> None:
    assert compare(part)[0] == []


def test_every_part_is_kept() -> None:
    kept = HERE / "kept"
    assert {str(path.relative_to(kept)).removesuffix(".json.gz") for path in kept.rglob("*.gz")} == set(PARTS)
