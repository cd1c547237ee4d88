"""Where a test stimulated: what was learnt at one place says nothing of another."""

from __future__ import annotations

from typing import Any

from stimrig.api.store.tables import Participant, Recording, Test

Site = tuple[str | None, str | None, str | None]
"""Side, muscle and where the electrodes are; None: nobody has said. Models, approvals and keys belong to one."""
Place = tuple[str | None, str | None, str | None, float | None]
"""A site, and the current, mA; None: not known."""


def site_of(row: Participant) -> Site:
    """Where a participant is stimulated now."""
    return row.side, row.muscle, row.placement


def holds_at(site: list[Any] | None, row: Participant) -> bool:
    """Whether all is still where it was when this was written down."""
    return stored_site(site) == site_of(row)


def site_of_recording(recording: Recording, test: Test | None) -> Site | None:
    """Where a recording's test stimulated; None: it was uploaded before that was kept."""
    if test is not None:
        return test.plan.get("side"), test.plan.get("muscle"), test.plan.get("placement")
    return stored_site(recording.site)


def stored_site(site: list[Any] | None) -> Site | None:
    """A site as it was written down."""
    return None if site is None else (site[0], site[1], site[2])


def in_words(site: Site) -> str:
    """As a person says it: left biceps brachii."""
    return " ".join(part for part in site if part) or "a side and muscle that nobody has said"


def place_of(row: Test) -> Place:
    """Where a test stimulated, and with what current, mA."""
    plan = row.plan
    return plan.get("side"), plan.get("muscle"), plan.get("placement"), plan.get("profile", {}).get("current_ma")


def differ(place: Place, other: Place) -> bool:
    """Whether two places are known to be different ones."""
    return any(a is not None and b is not None and a != b for a, b in zip(place, other, strict=True))
