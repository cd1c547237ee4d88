"""From a `TestPlan` to every pulse of the test. The whole test is built and checked before anything is sent.

A plan is one list of segments; each is built to a piece. A test that is extended while it plays gets more of them
later. Every limit holds for the whole test: its duration and charge, the charge of each second, and the rise from one
segment to the next.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import channels, protocols, sequences
from stimrig.rig.channels import Channel, RigChannel
from stimrig.rig.errors import PlanError, RefusedError
from stimrig.rig.limits import Limit, Refusal, Steps, admit, refuse
from stimrig.rig.messages import (
    HELD,
    MOVING,
    PASSIVE,
    SAFE_END_S,
    ChannelPreview,
    ChannelSequence,
    Preview,
    ProtocolInfo,
    RecruitmentTable,
    SegmentPlan,
    Sequences,
    TestPlan,
)
from stimrig.rig.signals import Pulse, Segment
from stimrig.rig.train import Train

USUAL_RATE_HZ = 40.0
MAX_SEGMENTS = 200
MAX_WIDTH_SETTING = "max_pulse_width_us"
"""If the plan does not give this setting of a sequence, it is the comfort maximum, or the request's limit if lower."""
NOTHING = np.empty(0)


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment, built: a width for each slot, µs, shape (n,), whole rounds, n >= 1.

    `jumps` says whether its sequence may rise to any allowed width within one pulse: of all channels, or of each.
    """

    of: SegmentPlan
    pulse_width_us: NDArray[np.float64]
    jumps: bool | tuple[bool, ...]

    def jumps_on(self, channel: int) -> bool:
        return self.jumps if isinstance(self.jumps, bool) else self.jumps[channel]


@dataclass(frozen=True, slots=True)
class PlannedTest:
    """A test ready to be played."""

    plan: TestPlan
    pulse_width_us: NDArray[np.float64]
    """Width for each slot, µs, shape (P,); `train` says when it is due."""
    segments: tuple[Segment, ...]
    pieces: tuple[Piece, ...]
    """Its segments, built; of an adaptive test those of its fixed plan, of which only the first is certain."""
    longest_s: float  # the longest that the test may take, s: its length, or the bound of an adaptive test
    channels: tuple[Channel, ...]
    train: Train

    @property
    def duration_s(self) -> float:
        """Length of the test, s; of an adaptive test that of its fixed plan."""
        return self.train.length_s(len(self.pulse_width_us))

    @property
    def charge_uc(self) -> float:
        """Charge of one phase summed over the pulses of all channels, µC."""
        return sum(dose_uc(self.pulse_width_us, self.channels))

    @property
    def first_pulse(self) -> int | None:
        """Slot of the earliest pulse that may stimulate; None: there is none."""
        if self.plan.kind == PASSIVE:
            return None  # nor can a client add one
        first = np.flatnonzero(self.pulse_width_us)
        if self.plan.adaptive is None:
            return int(first[0]) if len(first) else None
        extended = self.segments[0].end  # the first segment that a client adds may begin here
        return min(int(first[0]), extended) if len(first) else extended


def build(plan: TestPlan, table: dict[str, Limit], rig: Sequence[RigChannel] = ()) -> PlannedTest:
    """Build every pulse of the plan and check it against the limits.

    `plan`: as a client sent it; `table`: limits already narrowed by the profile; `rig`: the rig's channels. Raises
    PlanError: unknown sequence or channel, wrong setting, no segment, or a segment without a pulse: names the segment.
    """
    refuse(table["pulse_rate_hz"], plan.pulse_rate_hz, "plan")
    _check_angle(plan, table)
    playing, train = channels.played(plan, table, rig), channels.train(plan)
    channels.check_train(train, table)
    chosen = plan.segments
    if chosen is None:
        chosen = _by_protocol(plan, playing)
    if not chosen:
        raise PlanError("plan.segments is empty; leave it out for the default test, or give at least one segment")
    if len(chosen) > MAX_SEGMENTS:
        raise PlanError(f"plan.segments: {len(chosen)} segments, at most {MAX_SEGMENTS}; combine some of them")
    built = build_pieces(chosen, playing, train, table["duration_s"])
    check_pieces(built, playing, train, table)
    widths_us = np.concatenate([piece.pulse_width_us for piece in built])
    longest_s = train.length_s(len(widths_us))
    if plan.adaptive is not None:
        # it plays if nobody extends: it must fit into its bounds with its safe end
        whole = len(widths_us) + safe_end(widths_us, train)
        refuse(table["duration_s"], train.length_s(whole), "plan, with its safe end")
        longest_s = table["duration_s"].hi
    ends = np.cumsum([len(piece.pulse_width_us) for piece in built]).tolist()
    places = zip(built, [0, *ends[:-1]], ends, strict=True)
    segments = tuple(Segment(piece.of.name, start, end, "plan") for piece, start, end in places)
    return PlannedTest(plan, widths_us, segments, built, longest_s, playing, train)


def _by_protocol(plan: TestPlan, playing: Sequence[Channel]) -> list[SegmentPlan]:
    """Segments of a plan that names none. Raises PlanError: a protocol of one channel was named for several."""
    if len(playing) == 1:
        return protocols.segments(plan.protocol, min(playing[0].table["pulse_width_us"].hi, playing[0].largest_us))
    if plan.protocol != protocols.DEFAULT:
        raise PlanError(f"plan.protocol: {plan.protocol!r} is for one channel; leave it out, or give segments")
    return protocols.several([channel.name for channel in playing])


def _check_angle(plan: TestPlan, table: dict[str, Limit]) -> None:
    """What a kind of test needs of the angle, and whether its angles fit each other."""
    if plan.angle is None:
        if plan.kind in (PASSIVE, HELD, MOVING):
            raise PlanError(f"plan.angle: a {plan.kind} test needs it; give at least its range_rad")
        return
    target_rad = plan.angle.target_rad
    if plan.kind == HELD and target_rad is None:
        raise PlanError("plan.angle.target_rad: a held test needs the angle at which the joint is held")
    if target_rad is not None:
        refuse(table["angle_rad"], target_rad, "plan.angle.target_rad")


def build_pieces(
    chosen: Sequence[SegmentPlan], playing: Sequence[Channel], train: Train, longest: Limit, before: int = 0
) -> tuple[Piece, ...]:
    """Build segments that follow `before` slots; too long ones are refused before they are built.

    `longest`: limit on the duration of all slots, those before included. Raises PlanError: unknown sequence or channel,
    wrong setting, or a segment without a pulse: names the segment.
    """
    reached, counts, rate_hz = before, list[int](), train.pulse_rate_hz
    for number, segment in enumerate(chosen, start=1):
        with _named(number, segment):
            parts = [part for part in _parts(segment, playing) if part is not None]
            counts.append(max(sequences.pulse_count(part.sequence, part.settings, rate_hz) for part in parts))
            if min(sequences.pulse_count(part.sequence, part.settings, rate_hz) for part in parts) < 1:
                raise PlanError(f"too short for one pulse at {rate_hz:g} pulses/s; lengthen it")
        reached += counts[-1] * train.channels
        refuse(longest, train.length_s(reached), f"plan, up to segment {number}")
    built = []
    for number, (segment, count) in enumerate(zip(chosen, counts, strict=True), start=1):
        with _named(number, segment):
            parts, rounds = _parts(segment, playing), np.zeros((count, train.channels))
            for column, part in zip(rounds.T, parts, strict=True):
                if part is not None:
                    widths_us = sequences.build(part.sequence, part.settings, rate_hz)
                    column[: len(widths_us)] = widths_us
            jumps = tuple(part is not None and sequences.jumps(part.sequence, part.settings) for part in parts)
            built.append(Piece(segment, rounds.ravel(), jumps))
    return tuple(built)


def _parts(segment: SegmentPlan, playing: Sequence[Channel]) -> list[ChannelSequence | None]:
    """What each channel plays in a segment; None: it rests."""
    own, given = ChannelSequence(sequence=segment.sequence, settings=segment.settings), segment.channels or {}
    names = [channel.name for channel in playing]
    if unknown := sorted(set(given) - set(names)):
        raise PlanError(f"there is no channel {unknown[0]!r}; this test has {', '.join(filter(None, names)) or 'one'}")
    parts = [given.get(name, own if place == 0 else None) for place, name in enumerate(names)]
    return [part and _full(part, channel.largest_us) for part, channel in zip(parts, playing, strict=True)]


@contextlib.contextmanager
def _named(number: int, segment: SegmentPlan) -> Iterator[None]:
    try:
        yield
    except PlanError as error:
        raise PlanError(f"segment {number} ({segment.name}): {error}") from None


def _full(part: ChannelSequence, largest_us: float) -> ChannelSequence:
    """With the widest pulse, where the plan does not give it."""
    if MAX_WIDTH_SETTING not in sequences.find(part.sequence).Settings.model_fields:
        return part
    return ChannelSequence(sequence=part.sequence, settings={MAX_WIDTH_SETTING: largest_us, **part.settings})


def check_pieces(
    pieces: Sequence[Piece],
    playing: Sequence[Channel],
    train: Train,
    table: dict[str, Limit],
    before_us: NDArray[np.float64] = NOTHING,
) -> None:
    """Check pieces against the limits, as a part of the whole that they make with the slots before them.

    `table`: of the whole test. `before_us`: widths of all slots before them, µs, shape (n,), already checked. Raises
    RefusedError: names the limit, the value and the excess.
    """
    added_us = np.concatenate([piece.pulse_width_us for piece in pieces])
    for place, channel in enumerate(playing):
        _check_channel(pieces, place, channel, train, before_us, added_us)
    if train.channels > 1:
        current_ma = np.array([channel.current_ma for channel in playing])
        _check_sum(np.concatenate([before_us, added_us]) * 1e-3, current_ma, train, len(before_us), table)
    refuse(table["duration_s"], train.length_s(len(before_us) + len(added_us)), "plan")
    for place, channel in enumerate(playing):
        _check_rise(pieces, place, channel, train, before_us)


def _check_channel(
    pieces: Sequence[Piece], place: int, channel: Channel, train: Train,
    before_us: NDArray[np.float64], added_us: NDArray[np.float64],
) -> None:  # fmt: skip
    """One channel by itself, all but its rise."""
    table, current_ma, of = channel.table, channel.current_ma, _of(channel)
    before_us, added_us = before_us[place :: train.channels], added_us[place :: train.channels]
    for width_us in np.unique(added_us):
        verdict = admit(Pulse(float(width_us), current_ma), table)
        if isinstance(verdict, Refusal):
            raise RefusedError(f"{_place(pieces, width_us, place, train.channels)}{of}: {verdict}")
    window = min(max(1, round(train.pulse_rate_hz)), len(before_us) + len(added_us))
    recent_uc = np.concatenate([before_us[max(0, len(before_us) - window + 1) :], added_us]) * current_ma * 1e-3
    refuse(table["charge_per_second_uc"], _worst_uc(recent_uc, window), f"plan{of}")
    whole_uc = sequences.dose_uc(before_us, current_ma) + sequences.dose_uc(added_us, current_ma)
    refuse(table["charge_per_test_uc"], whole_uc, f"plan{of}")


def _check_sum(
    widths: NDArray[np.float64], current_ma: NDArray[np.float64], train: Train, before: int, table: dict[str, Limit]
) -> None:
    """All channels together. `widths`: of the whole, ms; `before`: slots of it that are checked already."""
    slot_ma = np.resize(current_ma, len(widths)) * (widths > 0)
    charge_uc, window = widths * slot_ma, min(max(1, round(train.slots_per_s)), len(widths))
    for row, value in (
        ("simultaneous_current_ma", float(slot_ma.max())),  # `channels.check_train`: no two pulses overlap
        ("all_charge_per_second_uc", _worst_uc(charge_uc[max(0, before - window + 1) :], window)),
        ("all_charge_per_test_uc", float(charge_uc.sum())),
    ):
        refuse(table[row], value, "plan")


def _worst_uc(charge_uc: NDArray[np.float64], window: int) -> float:
    return float(np.max(np.convolve(charge_uc, np.ones(window), "valid")))


def _check_rise(
    pieces: Sequence[Piece], place: int, channel: Channel, train: Train, before_us: NDArray[np.float64]
) -> None:
    last_us = float(before_us[place - train.channels]) if len(before_us) else 0.0
    for piece in pieces:
        widths_us = piece.pulse_width_us[place :: train.channels]
        if not piece.jumps_on(place):  # else the sequence jumps by design
            rises_us = np.diff(widths_us, prepend=last_us)
            first = int(np.argmax(rises_us))
            where = f"segment {piece.of.name}, pulse {first + 1}{_of(channel)}"
            refuse(channel.table["width_rise_us"], float(rises_us[first]), where)
        last_us = float(widths_us[-1])


def _of(channel: Channel) -> str:
    return channels.named([channel], 0)


def _place(pieces: Sequence[Piece], width_us: float, place: int, count: int) -> str:
    """Segment and pulse at which a width stands first on a channel, NaN included."""
    for piece in pieces:
        widths_us = piece.pulse_width_us[place::count]
        same = (widths_us == width_us) | np.isnan(widths_us) & np.isnan(width_us)
        if same.any():
            return f"segment {piece.of.name}, pulse {int(np.argmax(same)) + 1}"
    return "plan"


def dose_uc(widths_us: NDArray[np.float64], playing: Sequence[Channel]) -> list[float]:
    """Charge of one phase summed over each channel's pulses, µC."""
    return [
        sequences.dose_uc(widths_us[place :: len(playing)], channel.current_ma) for place, channel in enumerate(playing)
    ]


def safe_end(widths_us: NDArray[np.float64], train: Train) -> int:
    """Slots of width 0 that must still follow, so that the test ends with `SAFE_END_S` without stimulation.

    They end with a whole round.
    """
    played = np.flatnonzero(widths_us)
    resting = len(widths_us) - (int(played[-1]) + 1 if len(played) else 0)
    missing = max(0, train.slots(SAFE_END_S) - resting)
    return train.whole(len(widths_us) + missing) - len(widths_us)


def check_steps(test: PlannedTest, steps: Steps, rise: Limit) -> None:
    """Refuse a plan whose pulses this stimulator would all round to zero, be it as they climb. Raises PlanError."""
    if not (rise.hi >= steps.shortest_us):
        raise PlanError(
            f"width_rise_us: at most {rise.hi:g} µs a pulse is allowed, and this stimulator's smallest pulse is "
            f"{steps.shortest_us:g} µs: nothing would be sent; allow more"
        )
    for place, channel in enumerate(test.channels):
        widest_us, current_ma = float(test.pulse_width_us[place :: len(test.channels)].max()), channel.current_ma
        if widest_us > 0 and (steps.width_us(widest_us) == 0 or steps.current(current_ma) == 0):
            raise PlanError(
                f"plan{_of(channel)}: {widest_us:g} µs at {current_ma:g} mA would stimulate nothing: this stimulator's "
                f"smallest pulse is {steps.shortest_us:g} µs and {steps.current_ma:g} mA"
            )


def preview(test: PlannedTest, recruitment: RecruitmentTable | None = None) -> Preview:
    """Duration, dose and pulses, to be shown before the test is played.

    Raises PlanError: the recruitment table is not a curve, or there are several muscles.
    """
    train, widths_us = test.train, test.pulse_width_us
    torque_time_nms = None
    if recruitment is not None:
        if train.channels > 1:
            raise PlanError("recruitment: it is one muscle's, and this test stimulates several; leave it out")
        widths, torques = recruitment.pulse_width_us, recruitment.torque_nm
        if len(widths) != len(torques) or len(widths) < 2 or not np.all(np.diff(widths) > 0):
            raise PlanError("recruitment: give as many torques as pulse widths, at least two; the widths must increase")
        torque_time_nms = sequences.torque_time_nms(widths_us, train.pulse_rate_hz, widths, torques)
    return Preview(
        duration_s=test.duration_s,
        charge_uc=test.charge_uc,
        torque_time_nms=torque_time_nms,
        pulse_width_us=widths_us.tolist(),
        segments=[
            {"name": s.name, "start_s": train.length_s(s.start), "end_s": train.length_s(s.end)} for s in test.segments
        ],
        channels=_by_channel(test) if test.plan.channels else None,
    )


def _by_channel(test: PlannedTest) -> dict[str, ChannelPreview]:
    widths_us, count = test.pulse_width_us, len(test.channels)
    due_s, doses_uc = test.train.due_times_s(len(widths_us)), dose_uc(widths_us, test.channels)
    return {
        channel.name: ChannelPreview(
            charge_uc=doses_uc[place],
            pulse_time_s=due_s[place::count].tolist(),
            pulse_width_us=widths_us[place::count].tolist(),
        )
        for place, channel in enumerate(test.channels)
    }


def library() -> Sequences:
    """All sequences with their settings as a plan gives them, all protocols, and the default test."""
    found = sequences.described()
    for sequence in found:
        width = sequence.settings["properties"].get(MAX_WIDTH_SETTING)
        if width is not None:
            del width["default"]
            width["description"] += "; left out: the comfort maximum, or the test's own limit if that is lower"
    described = [_protocol(name, words) for name, words in protocols.described().items()]
    return Sequences(sequences=found, protocols=described, default=protocols.segments(protocols.DEFAULT, 0.0))


def _protocol(protocol_id: str, words: str) -> ProtocolInfo:
    chosen = protocols.segments(protocol_id, 0.0)
    pulses = sum(sequences.pulse_count(segment.sequence, segment.settings, USUAL_RATE_HZ) for segment in chosen)
    names = [segment.name for segment in chosen]
    return ProtocolInfo(id=protocol_id, description=words, segments=names, duration_s=pulses / USUAL_RATE_HZ)
