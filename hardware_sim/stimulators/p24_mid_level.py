"""The P24's pulses, and its mid level: the device repeats each channel's pulse until the host changes or stops it.

The host must send MLGetCurrentData at least every 2 s; silence stops the stimulation. A real device may accept other
commands as a sign of life. This one does not, so that a driver that works here works there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from stimrig.hardware_sim.stimulators.board import Board, Point
from stimrig.hardware_sim.timeline import Event, cancel

OK, TRANSFER, PARAMETER, NOT_INITIALISED, HIGH_VOLTAGE = 0, 1, 2, 7, 8
ELECTRODE, INVALID_COMMAND = 10, 11
ELECTRODE_DETECTION_MA = 15.0
LARGEST_CURRENT_MA = 130.0
POINT_BYTES = 4
CHANNELS = 8
SILENCE_S = 2.0
ALL_ERRORS = 4
SHORTEST_PERIOD_S = 0.0005
ELECTRODE_NIBBLE = 1


def parse_points(data: bytes, count: int) -> list[Point] | None:
    """`count` points of u32 big endian, µs << 20 | (2·mA + 300) << 10; None if the length differs."""
    if len(data) != count * POINT_BYTES:
        return None
    words = (int.from_bytes(data[i : i + POINT_BYTES], "big") for i in range(0, len(data), POINT_BYTES))
    return [(word >> 20, ((word >> 10 & 0x3FF) - 300) / 2) for word in words]


def within_limits(points: Sequence[Point]) -> bool:
    """Whether the device accepts this shape: currents within ±130 mA and some duration."""
    currents_fit = all(-LARGEST_CURRENT_MA <= current <= LARGEST_CURRENT_MA for _, current in points)
    return currents_fit and sum(width for width, _ in points) > 0


@dataclass
class Channel:
    """One running channel."""

    period_s: float
    points: list[Point]
    ramp_pulses: int
    fired: int = 0
    error: int = 0
    next_pulse: Event | None = field(default=None, repr=False)


class MidLevel:
    """The running channels and their watchdog."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._channels: dict[int, Channel] = {}
        self._errors: dict[int, int] = {}
        self._stop_on_error = False
        self._silence: Event | None = None

    @property
    def running(self) -> bool:
        """Whether any channel is pulsing."""
        return bool(self._channels)

    def start(self, stop_on_error: bool) -> None:
        """Ready, with no channel running."""
        self.stop()
        self._stop_on_error = stop_on_error
        self._errors.clear()

    def stop(self) -> None:
        """No pulse after this."""
        cancel(self._silence, *(channel.next_pulse for channel in self._channels.values()))
        self._channels.clear()
        self._silence = None

    def update(self, data: bytes) -> int:
        """MLUpdate: set each channel in the mask, stop the others; returns the result code."""
        wanted = _parse_update(data)
        if wanted is None:
            return PARAMETER
        for number in list(self._channels):
            if number not in wanted:
                self._end(number)
        for number, channel in wanted.items():
            running = self._channels.get(number)
            if running is None:
                self._errors.pop(number, None)
                self._channels[number] = channel
                self._schedule(number, channel, self._board.timeline.now_s)
            else:  # a running channel keeps its timing
                running.period_s, running.points = channel.period_s, channel.points
        if self.running and self._silence is None:
            self._alive()
        return OK

    def current_data(self, data: bytes) -> bytes:
        """MLGetCurrentData, which is the sign of life; its answer: result, selection, active mask, errors."""
        if data != bytes((ALL_ERRORS,)):
            return bytes((PARAMETER, *data[:1], *([0] * (6 - len(data[:1])))))
        if self.running:
            self._alive()
        active = sum(1 << number for number in self._channels)
        nibbles = sum(error << 4 * number for number, error in self._errors.items())
        result = ELECTRODE if self._errors else OK
        return bytes((result, ALL_ERRORS, active)) + nibbles.to_bytes(4, "little")

    def _alive(self) -> None:
        cancel(self._silence)
        self._silence = self._board.timeline.after(SILENCE_S, self.stop)

    def _schedule(self, number: int, channel: Channel, time_s: float) -> None:
        channel.next_pulse = self._board.timeline.at(time_s, lambda: self._fire(number, channel, time_s))

    def _fire(self, number: int, channel: Channel, time_s: float) -> None:
        channel.fired += 1
        share = min(1.0, channel.fired / (channel.ramp_pulses + 1))
        points = [(width, round(2 * current * share) / 2) for width, current in channel.points]
        works = self._board.high_voltage_works
        flowed = works and self._board.electrodes.fire(time_s, points, (number >> 2, number & 3), "mid level")
        strong = max(abs(current) for _, current in points) >= ELECTRODE_DETECTION_MA
        if not flowed and strong:
            self._errors[number] = ELECTRODE_NIBBLE
            if self._stop_on_error:
                self.stop()
            else:
                self._end(number)
            return
        self._schedule(number, channel, time_s + channel.period_s)

    def _end(self, number: int) -> None:
        cancel(self._channels.pop(number).next_pulse)


def _parse_update(data: bytes) -> dict[int, Channel] | None:
    """Channels of an MLUpdate: mask, then per channel (points-1) << 4 | ramp, u16 of (2·ms) << 1, points."""
    if not data:
        return None
    wanted: dict[int, Channel] = {}
    mask, rest = data[0], data[1:]
    for number in range(CHANNELS):
        if not mask >> number & 1:
            continue
        if len(rest) < 3:
            return None
        size = ((rest[0] >> 4) + 1) * POINT_BYTES
        points = parse_points(rest[3 : 3 + size], size // POINT_BYTES)
        word = int.from_bytes(rest[1:3], "big")
        period_s = (word >> 1) / (4000 if word & 1 else 2000)
        fits = points is not None and within_limits(points)
        if points is None or not fits or period_s <= sum(width for width, _ in points) * 1e-6:
            return None
        if not period_s >= SHORTEST_PERIOD_S:
            return None
        wanted[number] = Channel(period_s, points, ramp_pulses=rest[0] & 0xF)
        rest = rest[3 + size :]
    return wanted if not rest else None
