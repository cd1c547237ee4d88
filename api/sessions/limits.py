"""Limits for one test alone: they may be tighter than the participant's, never wider."""

from __future__ import annotations

from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.sessions import profiles
from stimrig.api.sessions.profiles import LIMITS
from stimrig.api.sessions.requests import TestIn
from stimrig.rig.messages import Profile


def limits_of(body: TestIn, own: dict[str, Any] | None) -> dict[str, Any]:
    """The limits of a test, as fields of a `TestPlan`.

    The participant's profile stays whole (thresholds, day, rest), so that the rig judges the calibration that a person
    made; what the request narrows is added to it.

    Parameters
    ----------
    body : TestIn
        The request; of its `profile`, only the fields that were sent count.
    own : dict or None
        The participant's profile.

    Raises
    ------
    ApiError
        422: the participant has no limits; a limit is wider than the participant's, which it is and by how much.
    """
    width_us, torque_nm = body.max_pulse_width_us, body.max_torque_nm
    asked = body.profile.sent() if body.profile else {}
    if lacking := [name for name in LIMITS if (own or {}).get(name) is None]:
        detail = (
            f"{body.participant} has no {', '.join(lacking)}. Set all of them: PUT /v1/participants/{{code}}/profile."
        )
        raise ApiError(422, "no-limits", "The participant has no limits", detail)
    assert own is not None
    profile = Profile(**own)
    wider = [words for name in LIMITS if name in asked if (words := _wider(name, asked[name], getattr(profile, name)))]
    range_rad = profiles.range_of(asked)
    if range_rad is not None and profile.angle_range_rad is None:
        wider.append(
            f"{profiles.RANGE} {profiles.range_words(range_rad)} narrows nothing: {body.participant} has no range"
        )
    elif range_rad is not None and not profiles.range_within(range_rad, profile.angle_range_rad):
        own_words = profiles.range_words(profile.angle_range_rad or ())
        wider.append(f"{profiles.RANGE} {profiles.range_words(range_rad)} is beyond the participant's {own_words}")
    if wider:
        detail = "; ".join(wider) + ". A test may narrow them; to widen them, calibrate anew or set the participant's."
        errors = [{"field": f"profile.{words.split()[0]}", "detail": words} for words in wider]
        raise ApiError(422, "wider-profile", "Wider than the participant's limits", detail, errors=errors)
    return {
        "profile": profile.model_copy(
            update={
                "current_ma": asked.get("current_ma", profile.current_ma),
                profiles.RANGE: range_rad or profile.angle_range_rad,
            }
        ),
        "max_pulse_width_us": tighter(width_us, asked.get("max_pulse_width_us")),
        "max_torque_nm": tighter(torque_nm, asked.get("max_torque_nm")),
    }


def _wider(name: str, asked: float, own: float) -> str | None:
    if asked <= own:  # a number that compares with nothing is wider
        return None
    unit = LIMITS[name].unit
    return f"{name} {asked:g} {unit} is above the participant's {own:g} {unit} by {asked - own:g}"


def tighter(one: float | None, other: float | None) -> float | None:
    """The smaller of those that are given."""
    given = [value for value in (one, other) if value is not None]
    return min(given) if given else None
