"""The RehaStim 2's channel list, which the device pulses with its own timing, and its single pulses."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from stimrig.hardware_sim.stimulators.board import Board, Point
from stimrig.hardware_sim.timeline import Event, cancel

OK, PARAMETER = 0, -2
NO_ERROR, EMERGENCY_SWITCH, ELECTRODE, MODULE = 0, -1, -2, -3
CHANNELS = 8
SHORTEST_US, LONGEST_US = 20, 500
LARGEST_MA, STEP_MA = 126, 2
GAP_US = 100
SHORTEST_INTERVAL_S = 0.008
LARGEST_LOW_FREQUENCY_FACTOR = 7
MOST_PULSES = 3
"""Modes 0, 1, 2 of a channel: single, doublet, triplet."""


class Pulse(NamedTuple):
    """One phase of a symmetric biphasic pulse; `pulses` of them an interpulse interval apart."""

    width_us: int
    current_ma: int
    pulses: int = 1

    @property
    def duration_s(self) -> float:
        """Duration of one pulse: both phases and the gap between them."""
        return (2 * self.width_us + GAP_US) * 1e-6

    def points(self) -> list[Point]:
        """The pulse's shape."""
        return [(self.width_us, self.current_ma), (GAP_US, 0), (self.width_us, -self.current_ma)]


class Setup(NamedTuple):
    """The settings of InitChannelList; `period_s` is 0 for one group of pulses per Start."""

    channels: tuple[int, ...]
    low_frequency: frozenset[int]
    low_frequency_factor: int
    interpulse_s: float
    period_s: float


def parse_init(data: bytes) -> Setup | None:
    """InitChannelList: factor, active mask, low-frequency mask, interpulse code, period code u16, execution.

    Execution other than 0 is refused, since its meaning is not known.
    """
    if len(data) != 7 or data[0] > LARGEST_LOW_FREQUENCY_FACTOR or data[6] != 0:
        return None
    factor, active, low, interpulse = data[:4]
    interpulse_s = 0.5e-3 * interpulse + 1.5e-3
    code = int.from_bytes(data[4:6], "big")
    period_s = 0.5e-3 * code + 1e-3 if code else 0.0
    if not active or interpulse_s < SHORTEST_INTERVAL_S or 0 < period_s < SHORTEST_INTERVAL_S:
        return None
    return Setup(_numbers(active), frozenset(_numbers(low)), factor, interpulse_s, period_s)


def parse_pulse(data: bytes) -> Pulse | None:
    """Width u16 and mA; None outside the device's limits. Odd currents are rounded down."""
    width_us, current_ma = int.from_bytes(data[:2], "big"), data[2]
    if not (SHORTEST_US <= width_us <= LONGEST_US and current_ma <= LARGEST_MA):
        return None
    return Pulse(width_us, current_ma - current_ma % STEP_MA)


def parse_start(data: bytes, setup: Setup) -> dict[int, Pulse] | None:
    """Start or Update: mode, width u16, mA for each active channel, in their order."""
    if len(data) != 4 * len(setup.channels):
        return None
    pulses = {}
    for place, channel in enumerate(setup.channels):
        count, pulse = data[4 * place] + 1, parse_pulse(data[4 * place + 1 : 4 * place + 4])
        if pulse is None or count > MOST_PULSES or 0 < setup.period_s < count * setup.interpulse_s:
            return None
        pulses[channel] = pulse._replace(pulses=count)
    return pulses


def fire(board: Board, time_s: float, channel: int, pulse: Pulse, source: str) -> int:
    """Fire one pulse at one output; returns 0 or the error for StimulationError."""
    if board.electrodes.cut:
        return EMERGENCY_SWITCH
    if not board.high_voltage_works:
        return MODULE
    if pulse.current_ma == 0:
        return NO_ERROR
    flowed = board.electrodes.fire(time_s, pulse.points(), (channel >> 2, channel & 3), source)
    return NO_ERROR if flowed else ELECTRODE


class ChannelList:
    """The running channels; `failed` is called with the error of a pulse that did not flow."""

    def __init__(self, board: Board, failed: Callable[[int], None]) -> None:
        self.setup = Setup((), frozenset(), 0, SHORTEST_INTERVAL_S, 0.0)
        self._board, self._failed = board, failed
        self._pulses: dict[int, Pulse] = {}
        self._group = 0
        self._next_group: Event | None = None
        self._rest: list[Event] = []
        self._one_shot_ends_s = 0.0

    @property
    def one_shot_runs(self) -> bool:
        """Whether the group of an earlier Start still runs."""
        return self.setup.period_s == 0 and self._board.timeline.now_s < self._one_shot_ends_s

    def set_up(self, setup: Setup) -> None:
        """Use this setup; nothing runs."""
        self.stop()
        self.setup = setup

    def start(self, pulses: dict[int, Pulse]) -> None:
        """Fire the first group at once. If the list runs already, the pulses apply from the next group on."""
        self._pulses = pulses
        if self.setup.period_s == 0:
            self._one_shot_ends_s = self._board.timeline.now_s + max(
                (pulse.pulses - 1) * self.setup.interpulse_s + pulse.duration_s for pulse in pulses.values()
            )
        if self._next_group is None:
            self._fire_group(self._board.timeline.now_s)

    def stop(self) -> None:
        """No pulse after this."""
        cancel(self._next_group, *self._rest)
        self._next_group = None
        self._rest.clear()
        self._pulses = {}
        self._group = 0
        self._one_shot_ends_s = 0.0

    def _fire_group(self, time_s: float) -> None:
        self._rest.clear()
        if self.setup.period_s > 0:
            next_s = time_s + self.setup.period_s
            self._next_group = self._board.timeline.at(next_s, lambda: self._fire_group(next_s))
        due = [channel for channel in self._pulses if self._is_due(channel)]
        self._group += 1
        for index in range(1, MOST_PULSES):
            at_s = time_s + index * self.setup.interpulse_s
            channels = [channel for channel in due if self._pulses[channel].pulses > index]
            if channels:
                self._rest.append(self._board.timeline.at(at_s, lambda c=channels, t=at_s: self._fire(c, t)))
        self._fire(due, time_s)  # last, since a failure cancels all that was planned

    def _is_due(self, channel: int) -> bool:
        """A low-frequency channel skips as many groups as the factor says after each one it fires in."""
        return channel not in self.setup.low_frequency or self._group % (self.setup.low_frequency_factor + 1) == 0

    def _fire(self, channels: list[int], time_s: float) -> None:
        for channel in channels:
            pulse = self._pulses.get(channel)
            error = fire(self._board, time_s, channel, pulse, "channel list") if pulse else NO_ERROR
            if error != NO_ERROR:
                self._failed(error)
                return


def _numbers(mask: int) -> tuple[int, ...]:
    return tuple(channel for channel in range(CHANNELS) if mask >> channel & 1)
