"""Which electrode of an array: a search of short tests, one stimulus each. What comes next is found by a worker."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.sessions import channels
from stimrig.api.sessions.channels import ChannelName
from stimrig.api.sessions.kinds import Kind, Planned
from stimrig.api.sessions.requests import CurrentMa, TestIn, WidthUs
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store, seen
from stimrig.api.store.tables import OPEN_STATES, AuditEntry, Participant, Search, Test
from stimrig.rig.messages import ChannelPlan, Profile, SegmentPlan, Status, TestPlan

ELECTRODE = "electrode"
"""Kind of a test of one stimulus."""
REST_S, RAMP_S, HOLD_S = 0.3, 0.6, 0.4
"""Of a stimulus: without pulses, rising to its width, held there."""
FARTHEST_PITCHES = 2.3
"""Pairs that lie farther apart are no choice: the current of each flows for itself."""
EARLIER = 2
"""So many former searches of a person count."""
WISHES = {
    "balanced": "Torque, selectivity and comfort, each at a price.",
    "strong": "The largest torque that is bearable; a strong spill-over is never acceptable.",
    "selective": "The wanted muscle alone; a slight spill-over costs more than half.",
    "comfortable": "Torque that can be borne for long: what feels bad counts little.",
}
"""As `stimrig.identify.electrodes.PRESETS`, which the service does not load."""


@dataclass(frozen=True)
class Array:
    """The elements behind the rig's switch; `key`: of their channel, as `channels.held` takes it."""

    channel: str
    key: str
    elements: int
    laid: dict[str, Any]  # rows, columns and pitch_mm, as far as the rig file tells them


def array_of(status: Status | None) -> Array | None:
    """The rig's array; None where it has no switch."""
    switch = status.switch if status is not None else None
    if status is None or not switch:
        return None
    first = next((one["name"] for one in status.stimulator.get("channels") or []), switch["channel"])
    laid = {name: switch[name] for name in ("rows", "columns", "pitch_mm") if switch.get(name)}
    key = "" if switch["channel"] == first else switch["channel"]
    return Array(switch["channel"], key, switch["elements"], laid)


def needed(status: Status | None) -> Array:
    """The same. Raises ApiError: 409 the rig has no switch."""
    found = array_of(status)
    if found is None:
        detail = "No channel of this rig has a switch to an array. The rig file names one under [switch]."
        raise ApiError(409, "no-switch", "This rig has no electrode array", detail)
    return found


def elements_of_first(row: Participant, status: Status | None) -> list[int]:
    """The elements of the first channel; empty where no switch is at it. Raises ApiError: as `held_elements`."""
    array = array_of(status)
    return held_elements(row, array) if array is not None and not array.key else []


def refuse_other_channel(array: Array, channel: str) -> None:
    """Raise ApiError (409) where a search is of another channel than the one with the switch."""
    if array.channel != channel:
        detail = f"The search is of {channel}, the switch is at {array.channel}. Begin another one."
        raise ApiError(409, "no-switch", "The array is at another channel", detail)


def refuse_closed(row: Search) -> None:
    """Raise ApiError (409) for a search that plays no more."""
    if row.state == "closed":
        raise ApiError(409, "closed", "This search is closed", "Begin another one; it knows what this one has seen.")


def refuse_untold(now: dict[str, Any]) -> None:
    """Raise ApiError (409) until it was told what the last stimulus of a search gave."""
    if now["playing"] or now["waiting"]:
        raise ApiError(409, "not-told", "The last stimulus was not told yet", "Tell first what it gave.")


def words(elements: Sequence[int]) -> str:
    """A choice as it is written into the placement, and read there."""
    return f"element {elements[0]}" if len(elements) == 1 else f"elements {elements[0]} and {elements[1]}"


def chosen_at(placement: str | None) -> list[int]:
    """The elements that a placement names; empty where it names none."""
    found = re.fullmatch(r"elements? (\d{1,3})(?: and (\d{1,3}))?", placement or "")
    return [int(number) for number in found.groups() if number] if found else []


def held_elements(row: Participant, array: Array) -> list[int]:
    """The elements that a participant's placement names. Raises ApiError: 409 it names none of this array."""
    found = chosen_at(channels.held(row, array.key)["placement"])
    if not found or max(found) > array.elements:
        detail = f"No element of the array is chosen for {row.code}. Search for one, or name it: placement “element 3”."
        raise ApiError(409, "no-element", "No electrode is chosen", detail)
    return found


def connected(plan: TestPlan, row: Participant, status: Status | None) -> TestPlan:
    """A plan with the elements that the switch connects for this participant; as it is on a rig without a switch.

    Raises ApiError: 409 none is chosen.
    """
    array = array_of(status)
    if array is None or plan.kind == ELECTRODE:
        return plan
    playing = plan.channels
    if playing is None:
        if array.key:  # the switch is at another channel than the one that plays
            return plan
        playing = [ChannelPlan(name=array.channel, profile=plan.profile)]
    if array.channel not in {one.name for one in playing}:
        return plan
    elements = held_elements(row, array)
    own = {True: {"elements": elements}, False: {}}
    return plan.model_copy(
        update={"channels": [one.model_copy(update=own[one.name == array.channel]) for one in playing]}
    )


def positions_mm(rows: int, columns: int, pitch_mm: float) -> list[list[float]]:
    """Where the elements lie: numbered along the rows."""
    return [[column * pitch_mm, row * pitch_mm] for row in range(rows) for column in range(columns)]


def shortened(document: dict[str, Any], earlier: int) -> dict[str, Any]:
    """A search with so many former ones."""
    prior = document["prior"]
    return {**document, "prior": shortened(prior, earlier - 1) if prior and earlier else None}


def refuse_wider(own: dict[str, Any], width_us: float, current_ma: float) -> None:
    """Raise ApiError (422) where the participant's limits of that channel are tighter, or nobody has set them."""
    asked = {"max_pulse_width_us": width_us, "current_ma": current_ma}
    if lacking := [name for name in (*asked, "max_torque_nm") if own.get(name) is None]:
        detail = f"There is no {', '.join(lacking)} on the array's channel. Calibrate it, or set the limits."
        raise ApiError(422, "no-limits", "The participant has no limits", detail)
    if wider := [f"{name} {value:g} is above {own[name]:g}" for name, value in asked.items() if value > own[name]]:
        detail = f"{', '.join(wider)}, the participant's limit. Begin a search within it."
        raise ApiError(422, "wider-profile", "Wider than the participant's limits", detail)


class StimulusIn(TestIn):
    """One stimulus of a search; no request has it."""

    search_id: str
    elements: list[int]
    channel: ChannelName
    width_us: WidthUs
    asked_ma: CurrentMa


class ElectrodeTests(Kind):
    """Plans them: a rest, a rise of the pulse width, a short hold. They give no model."""

    names, fitted = (ELECTRODE,), False

    def __init__(self, rig: RigClient, store: Store) -> None:
        super().__init__(rig)
        self.store = store

    async def planned(self, body: TestIn, plan: TestPlan, preview_s: float) -> Planned:  # noqa: ARG002
        """As `Kind`. Raises ApiError: 409 no such switch; 422 it is of no search, or beyond the limits."""
        if not isinstance(body, StimulusIn):
            detail = "It belongs to a search: POST /v1/participants/{code}/searches begins one."
            raise ApiError(422, "of-a-search", "Such a test is not started by itself", detail)
        await asyncio.to_thread(self._refuse_untold, body.search_id)
        row: Participant = await asyncio.to_thread(self.store.get, Participant, plan.participant)
        array = needed(self.rig.status)
        own = channels.held(row, array.key)["profile"]
        refuse_other_channel(array, body.channel)
        refuse_wider(own, body.width_us, body.asked_ma)
        profile = Profile(**own).model_copy(update={"current_ma": body.asked_ma})
        channel = ChannelPlan(
            name=array.channel, profile=profile, max_pulse_width_us=body.width_us, elements=body.elements
        )
        rise, hold = (round(length_s * plan.pulse_rate_hz) for length_s in (RAMP_S, HOLD_S))
        widths = [body.width_us * min(1.0, (k + 1) / rise) for k in range(rise + hold)]
        segments = [
            SegmentPlan(name="rest", sequence="rest", settings={"duration_s": REST_S}),
            SegmentPlan(name="stimulus", sequence="widths", settings={"pulse_width_us": widths}),
        ]
        played = plan.model_copy(update={"profile": profile, "channels": [channel], "segments": segments})
        kept = {"search": body.search_id, "elements": body.elements}
        side, muscle = (channels.held(row, array.key)[name] for name in ("side", "muscle"))
        at = words(body.elements)
        site = {"sites": {array.key: [side, muscle, at]}} if array.key else {"placement": at}
        return Planned(played, kept | site)

    def _refuse_untold(self, search_id: str) -> None:
        """Raise ApiError (409): the last stimulus was not told, or a page is older than what was told, or a stop."""
        row: Search = self.store.get(Search, search_id)
        refuse_closed(row)
        refuse_untold(document(self.store, row))
        self.store.refuse_changed(*rests_of(row))


def rests_of(row: Search) -> tuple[seen.About, ...]:
    """What a stimulus rests on: limits, what was told of those before, and that nothing was stopped since."""
    told = seen.actions_on(row.id, "tell stimulus")
    return seen.participant(row.participant), told, AuditEntry.action.in_(("stop", "re-arm"))


def tests_of(store: Store, row: Search) -> list[Test]:
    """The stimuli of a search, in order."""
    own = Test.participant == row.participant, Test.kind == ELECTRODE, Test.requested_utc >= row.created_utc
    rows = store.all(Test, *own, order=Test.requested_utc)
    return [test for test in rows if test.plan.get("search") == row.id]


def document(store: Store, row: Search) -> dict[str, Any]:
    """A search as clients see it."""
    told = {each["test_id"]: each for each in row.told}
    blank = dict.fromkeys(("spill", "comfort", "torque_nm", "by", "at_utc"))
    stimuli = [
        {"test_id": test.id, "elements": test.plan["elements"], "state": test.state, **blank, **told.get(test.id, {})}
        for test in tests_of(store, row)
    ]
    waits = next((one for one in stimuli[-1:] if one["comfort"] is None), None)
    plays = waits is not None and waits["state"] in OPEN_STATES
    ended = waits is not None and waits["state"] == "completed"
    return {
        "id": row.id, "participant": row.participant, "channel": row.channel, "state": row.state, **row.asked,
        "stimuli": stimuli, "playing": plays, "waiting": waits["test_id"] if waits and ended else None,
        "chosen": row.chosen, "prior": row.document["prior"] is not None, **row.standing,
        "left_out": left_out(stimuli),
        **{name: getattr(row, name) for name in ("created_by", "created_utc", "closed_by", "closed_utc")},
    }  # fmt: skip


def left_out(stimuli: Sequence[dict[str, Any]]) -> list[list[int]]:
    """Choices whose stimulus was stopped: they are not proposed again."""
    return [list(each) for each in sorted({tuple(one["elements"]) for one in stimuli if one["state"] == "stopped"})]
