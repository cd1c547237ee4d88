"""Where a test stimulated: what was learnt at one place says nothing of another."""

from __future__ import annotations

from api.store.tables import Test

Place = tuple[str | None, str | None, float | None]
"""Side, muscle, and current, mA; None: not known."""


def place_of(row: Test) -> Place:
    """Where a test stimulated, and with what current, mA."""
    return row.plan.get("side"), row.plan.get("muscle"), row.plan.get("profile", {}).get("current_ma")


def differ(one: Place, other: Place) -> bool:
    """Whether two places are known to be different ones."""
    return any(a is not None and b is not None and a != b for a, b in zip(one, other, strict=True))
