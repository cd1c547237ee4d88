"""The site of a test: results from one site are not valid at another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # reports are written where no database is installed
    from stimrig.api.store.tables import Participant, Recording, Test

Site = tuple[str | None, str | None, str | None]
"""Side, muscle and electrode placement; None: unknown. Models, approvals and keys belong to one site."""
Place = tuple[str | None, str | None, str | None, float | None]
"""A site, and the current, mA; None: not known."""


def site_of(row: Participant) -> Site:
    """Return the participant's current stimulation site."""
    return row.side, row.muscle, row.placement


def stored_site(site: list[Any] | None) -> Site | None:
    """Return the site of its stored list."""
    return None if site is None else (site[0], site[1], site[2])


def site_of_recording(recording: Recording, test: Test | None) -> Site | None:
    """Return the site of a recording's test; None: uploaded before sites were stored."""
    return stored_site(recording.site) if test is None else place_of(test)[:3]


def current_of_recording(recording: Recording, test: Test | None) -> float | None:
    """Return the current (mA) of a recording's test or of its file; None: unknown, or joined of several currents."""
    return next(iter((recording.site or [])[3:]), None) if test is None else place_of(test)[3]


def in_words(site: Site) -> str:
    """Return the site in words: left biceps brachii."""
    return " ".join(part for part in site if part) or "a side and muscle that nobody has said"


def place_of(row: Test) -> Place:
    """Return the site and current (mA) of a test."""
    plan = row.plan
    return plan.get("side"), plan.get("muscle"), plan.get("placement"), plan.get("profile", {}).get("current_ma")


def differ(place: Place, other: Place) -> bool:
    """Return whether two places are known to differ."""
    return any(a is not None and b is not None and a != b for a, b in zip(place, other, strict=True))
