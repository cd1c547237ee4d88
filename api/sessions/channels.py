"""A rig's channels, and what a participant has on each of them.

The first channel is what a participant has anyway: side, muscle, placement and profile. Further ones stand in
`Participant.channels`, by their names. On a rig of one channel there are none. Under `FIRST` stands there which channel
was the first one when its limits were set: on a rig with another first one they are not that channel's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import StringConstraints

from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.models.places import Site
from stimrig.api.sessions.profiles import LIMITS
from stimrig.api.store.tables import Participant
from stimrig.rig.messages import CHANNEL_NAME, ChannelPlan, Profile, Status, TestPlan

ChannelName = Annotated[str, StringConstraints(pattern=CHANNEL_NAME)]
FIRST = ""
NOTHING: dict[str, Any] = {"side": None, "muscle": None, "placement": None, "profile": {}}


@dataclass(frozen=True)
class Channel:
    """A channel, and what a participant has on it."""

    number: int  # from 1: its place on the rig, and its colour
    name: str
    key: str  # as `held` takes it: empty for the first
    site: Site
    profile: dict[str, Any]  # empty: nobody has set its limits


def of_rig(status: Status | None) -> list[str]:
    """Names of the rig's channels; none of a rig of one, or that has not spoken."""
    told = (status.stimulator.get("channels") or []) if status is not None else []
    return [str(one["name"]) for one in told] if len(told) > 1 else []


def first_of(status: Status | None) -> str | None:
    """Name of the rig's first channel, though it be the only one; None where it has none."""
    told = (status.stimulator.get("channels") or []) if status is not None else []
    return str(told[0]["name"]) if told else None


def key_of(status: Status | None, name: str) -> str:
    """A channel as `held` takes it. Raises NotFoundError (404): the rig has none of that name."""
    names = of_rig(status)
    if name not in names:
        has = f"This rig has {', '.join(names)}." if names else "This rig has one channel, which needs no name."
        raise NotFoundError("channel", name, has)
    return "" if name == names[0] else name


def held(row: Participant, key: str = "") -> dict[str, Any]:
    """Side, muscle, placement and profile of a channel."""
    if not key:
        return {name: getattr(row, name) for name in NOTHING}
    return {**NOTHING, **((row.channels or {}).get(key) or {})}


def put(row: Participant, key: str, status: Status | None, **new: Any) -> None:
    """Change some of it; with `profile` of the first channel also which channel that is."""
    if key:
        row.channels = {**(row.channels or {}), key: {**held(row, key), **new}}
        return
    for name, value in new.items():
        setattr(row, name, value)
    if "profile" in new and (first := first_of(status)):  # what it had as a further channel is older
        others = {name: one for name, one in (row.channels or {}).items() if name != first}
        row.channels = {**others, FIRST: {"name": first}}


def is_reordered(row: Participant, status: Status | None) -> bool:
    """Whether what the participant has on the first channel was found on another one than the rig's first."""
    now, known = first_of(status), row.channels or {}
    before = known.get(FIRST, {}).get("name")
    return now is not None and before != now and (before is not None or now in known)


def refuse_reordered(row: Participant, status: Status | None) -> None:
    """Raise ApiError (409) there: the limits and thresholds of one channel are never another one's."""
    if not is_reordered(row, status):
        return
    before = (row.channels or {}).get(FIRST, {}).get("name", "another one")
    detail = (
        f"The first channel of this rig is {first_of(status)}, the limits of {row.code} were set where it was "
        f"{before}. Set all of them anew, or restore the order in the rig file."
    )
    raise ApiError(409, "other-order", "The rig's channels have another order", detail)


def of(row: Participant, status: Status | None) -> list[Channel]:
    """All of the rig's channels with what the participant has on each; none on a rig of one."""
    found = []
    for number, name in enumerate(of_rig(status), start=1):
        own = held(row, key := name if number > 1 else "")
        site = own["side"], own["muscle"], own["placement"]
        found.append(Channel(number, name, key, site, own["profile"]))
    return found


def needed(row: Participant, status: Status | None) -> list[Channel]:
    """The same, for what stimulates all of them.

    Raises ApiError: 409 the rig has one channel; 422 nobody has set the limits of one.
    """
    found = of(row, status)
    if not found:
        detail = "This rig has one channel. The rig file names more under [[stimulator.channels]]."
        raise ApiError(409, "one-channel", "The rig has one channel", detail)
    if lacking := [one.name for one in found if not one.profile]:
        detail = (
            f"{row.code} has no limits on {', '.join(lacking)}. Calibrate it, or set them: "
            "PUT /v1/participants/{code}/channels/{channel}/profile."
        )
        raise ApiError(422, "no-limits", "The participant has no limits", detail)
    return found


def for_all(plan: TestPlan, row: Participant, status: Status | None) -> tuple[TestPlan, dict[str, Any]]:
    """A plan that plays on all of the rig's channels, with the participant's profile on each; and what is kept of it.

    What the request narrows is narrowed on each.

    Raises ApiError: as `needed`.
    """
    playing = needed(row, status)
    asked = plan.profile.model_dump(include=set(LIMITS))
    own = row.profile
    narrower = {name: value for name, value in asked.items() if value is not None and value < own.get(name, value)}
    plans = []
    for one in playing:
        least = {name: min(value, one.profile.get(name, value)) for name, value in narrower.items()}
        plans.append(ChannelPlan(name=one.name, profile=Profile(**one.profile | least)))
    plans[0].profile = plan.profile
    sites = {one.name: list(one.site) for one in playing if one.key}
    return plan.model_copy(update={"channels": plans}), {"sites": sites}
