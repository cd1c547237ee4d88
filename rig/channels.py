"""The channels of a rig, and those that a test plays: which output each has, and the limits that hold for it alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from stimrig.rig import limits
from stimrig.rig.errors import PlanError
from stimrig.rig.limits import Limit, refuse
from stimrig.rig.messages import ChannelPlan, TestPlan
from stimrig.rig.train import Train, train_of


@dataclass(frozen=True, slots=True)
class RigChannel:
    """A channel as the rig file describes it."""

    name: str
    muscle: str
    side: str
    electrode: str
    limits: Mapping[str, float] = field(default_factory=dict)  # tighter ones, by the names of the rows

    def described(self) -> dict[str, str]:
        return {"name": self.name, "muscle": self.muscle, "side": self.side, "electrode": self.electrode}


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel that a test plays.

    `table` holds for it alone. Where the test has one channel that nobody named, it is the whole test's.
    """

    name: str
    output: int  # place among the rig's channels
    current_ma: float
    largest_us: float
    table: dict[str, Limit]


def played(plan: TestPlan, table: dict[str, Limit], rig: Sequence[RigChannel]) -> tuple[Channel, ...]:
    """The channels of a test, in the order of its slots.

    `table`: the limits of the whole test (`limits.for_plan`). `rig`: the rig's channels; empty: it has one without a
    name. Raises PlanError, RefusedError: a channel that the rig does not have, or one twice; a limit.
    """
    profile = plan.profile
    if plan.channels is None:
        table = limits.narrowed(table, rig[0].limits, f"rig file, {rig[0].name}") if rig else table
        return (Channel("", 0, profile.current_ma, plan.largest_us, table),)
    names = [channel.name for channel in plan.channels]
    known = {channel.name: place for place, channel in enumerate(rig)}
    for name in names:
        if name not in known:
            has = f"this rig has {', '.join(known)}" if known else "this rig's channel has no name: leave channels out"
            raise PlanError(f"plan.channels: there is no channel {name!r}; {has}")
        if names.count(name) > 1:
            raise PlanError(f"plan.channels: {name!r} is given twice; give each channel once")
    if profile != plan.channels[0].profile:
        raise PlanError(f"plan.profile: give that of the first channel, {names[0]}")
    return tuple(_channel(one, known[one.name], rig[known[one.name]], plan, table) for one in plan.channels)


def _channel(one: ChannelPlan, output: int, of: RigChannel, plan: TestPlan, table: dict[str, Limit]) -> Channel:
    table = limits.narrowed(table, of.limits, f"rig file, {of.name}")
    table = limits.for_pulses(table, one.profile, f"profile of {one.name}")
    asked_us = [width_us for width_us in (one.max_pulse_width_us, plan.max_pulse_width_us) if width_us is not None]
    for width_us in asked_us:
        table = limits.tightened(table, "pulse_width_us", width_us, "request")
    largest_us = min(one.profile.max_pulse_width_us, *asked_us, float("inf"))
    return Channel(one.name, output, one.profile.current_ma, largest_us, table)


def train(plan: TestPlan) -> Train:
    """The train of a plan, whose offsets may still be wrong."""
    return train_of(plan.pulse_rate_hz, [0.0] if plan.channels is None else [one.offset_s for one in plan.channels])


def check_train(of: Train, table: dict[str, Limit]) -> None:
    """Raise PlanError or RefusedError unless the slots of a round follow each other with the gap that they need."""
    if of.channels == 1:
        if of.offsets_s != (0.0,):
            raise PlanError("plan.channels: the offset_s of the first channel is 0")
        return
    if of.offsets_s[0] != 0.0:
        raise PlanError("plan.channels: the offset_s of the first channel is 0; those of the others rise from there")
    for channel in range(of.channels):
        refuse(table["channel_gap_s"], of.gap_s(channel), f"plan.channels: after channel {channel + 1}")


def named(channels: Iterable[Channel], channel: int) -> str:
    """` of channel NAME`; empty where it has none."""
    name = next((one.name for place, one in enumerate(channels) if place == channel), "")
    return f" of channel {name}" if name else ""
