"""Hasomed RehaMove P24's firmware, ScienceMode 4: general commands, low level and mid level.

Low level: the host sends one LLChannelConfig per pulse. Silence means no stimulation. Mid level: the device repeats
each channel's pulse until the host changes or stops it. The host must send MLGetCurrentData at least every 2 s; silence
stops the stimulation. A real device may accept other commands as a sign of life. This one does not, so that a driver
that works here works there. Measurements, other sources of high voltage, ramps and MLInit's stop on errors are refused.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from stimrig.hardware_sim.stimulators.board import Board, Firmware, Point
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode4
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
    """A shape of `count` points of u32 big endian, µs << 20 | (2·mA + 300) << 10.

    None where the device does not accept it: another length, currents beyond ±130 mA, or no duration.
    """
    if len(data) != count * POINT_BYTES:
        return None
    points = [(word >> 20, ((word >> 10 & 0x3FF) - 300) / 2) for (word,) in struct.iter_unpack(">I", data)]
    return points if largest_ma(points) <= LARGEST_CURRENT_MA and duration_s(points) > 0 else None


def largest_ma(points: list[Point]) -> float:
    """The largest current of either sign."""
    return max(abs(current) for _, current in points)


def duration_s(points: list[Point]) -> float:
    """How long the shape lasts."""
    return sum(width for width, _ in points) * 1e-6


@dataclass
class Channel:
    """A channel that runs at mid level."""

    period_s: float
    points: list[Point]
    next_pulse: Event | None = None


def _parse_update(data: bytes) -> dict[int, Channel] | None:
    """Channels of an MLUpdate: mask, then per channel (points-1) << 4 | ramp, u16 of (2·ms) << 1, points."""
    wanted: dict[int, Channel] = {}
    mask, rest = data[:1], data[1:]
    for number in range(CHANNELS):
        if not mask or not mask[0] >> number & 1:
            continue
        if len(rest) < 3 or rest[0] & 0xF:
            return None
        count, word = (rest[0] >> 4) + 1, int.from_bytes(rest[1:3], "big")
        points = parse_points(rest[3 : 3 + count * POINT_BYTES], count)
        period_s = (word >> 1) / (4000 if word & 1 else 2000)
        if points is None or period_s <= duration_s(points) or period_s < SHORTEST_PERIOD_S:
            return None
        wanted[number] = Channel(period_s, points)
        rest = rest[3 + count * POINT_BYTES :]
    return wanted if mask and not rest else None


LL_INIT, LL_CHANNEL_CONFIG, LL_STOP = 0, 2, 4
ML_INIT, ML_UPDATE, ML_STOP, ML_GET_CURRENT_DATA = 30, 32, 34, 36
DEVICE_ID, RESET, STIM_STATUS, GENERAL_ERROR, UNKNOWN_COMMAND, EXTENDED_VERSION = 52, 58, 62, 66, 67, 68
SWITCH_TIME_S = 0.040
RESET_TIME_S = 0.2
HIGH_VOLTAGE_ON = 6
NO_LEVEL, LOW_LEVEL, MID_LEVEL_READY, MID_LEVEL_RUNNING = 0, 1, 2, 3
MODES = ("none", "low level", "mid level", "mid level running")


class P24(Firmware):
    """The P24's state machine; commands are done one after another, in the order they came."""

    device, wire = "P24", ScienceMode4

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self._queue: deque[Packet] = deque()
        self._doing: Event | None = None
        self._level = NO_LEVEL
        self._channels: dict[int, Channel] = {}
        self._errors: dict[int, int] = {}
        self._silence: Event | None = None
        self._handlers: dict[int, Callable[[Packet], None]] = {
            LL_INIT: lambda p: self._init(p, LOW_LEVEL),
            LL_CHANNEL_CONFIG: self._ll_channel_config,
            LL_STOP: lambda p: self._stop(p, LOW_LEVEL),
            ML_INIT: lambda p: self._init(p, MID_LEVEL_READY),
            ML_UPDATE: self._ml_update,
            ML_STOP: lambda p: self._stop(p, MID_LEVEL_READY),
            ML_GET_CURRENT_DATA: self._ml_get_current_data,
            DEVICE_ID: lambda p: self._ack(p, OK, *b"EMULATED24"),
            RESET: self._reset_command,
            STIM_STATUS: lambda p: self._ack(p, OK, self.level, HIGH_VOLTAGE_ON if self.high_voltage_on else 0),
            # firmware 1.0.0, ScienceMode 4.0.0, hash 0 of kind git, valid
            EXTENDED_VERSION: lambda p: self._ack(p, OK, 1, 0, 0, 4, 0, 0, 0, 0, 0, 0, 1, 1),
        }

    @property
    def level(self) -> int:
        """Stimulation status as the protocol counts it: 0 none, 1 low, 2 mid, 3 mid running."""
        return MID_LEVEL_RUNNING if self._channels else self._level

    @property
    def high_voltage_on(self) -> bool:
        """True while the source that drives the pulses is on."""
        return self._level != NO_LEVEL and self._board.high_voltage_works

    def received(self, data: bytes) -> None:
        """Bytes from the host; a corrupt frame is answered with a general error."""
        corrupt = self._wire.corrupt_frames
        packets = self._wire.feed(data, self._board.timeline.now_s)
        if self._wire.corrupt_frames > corrupt:
            self._send(0, GENERAL_ERROR, bytes((TRANSFER,)))
        self._queue.extend(packets)
        self._work()

    def reset(self) -> None:
        """Power lost and back: no stimulation, nothing initialised, commands forgotten."""
        self._queue.clear()
        cancel(self._doing)
        self._doing = None
        self._end_levels()

    def mode(self) -> tuple[str, bool]:
        """Its level, and whether the source is on."""
        return MODES[self.level], self.high_voltage_on

    def _work(self) -> None:
        while self._queue and self._doing is None:
            packet = self._queue.popleft()
            self.commands[packet.command] += 1
            self._handlers.get(packet.command, self._unknown)(packet)

    def _later(self, delay_s: float, finish: Callable[[], None]) -> None:
        """Be busy for `delay_s`, then finish and take the next command."""

        def done() -> None:
            self._doing = None
            finish()
            self._work()

        self._doing = self._board.timeline.after(delay_s, done)

    def _ack(self, packet: Packet, *data: int) -> None:
        self._send(packet.number, packet.command + 1, bytes(data))

    def _end_levels(self) -> None:
        cancel(self._silence, *(channel.next_pulse for channel in self._channels.values()))
        self._channels.clear()
        self._level, self._silence = NO_LEVEL, None

    def _unknown(self, packet: Packet) -> None:
        self._send(packet.number, UNKNOWN_COMMAND, bytes((INVALID_COMMAND,)))

    def _reset_command(self, packet: Packet) -> None:
        self._ack(packet, OK)
        self._end_levels()
        self._queue.clear()
        self._later(RESET_TIME_S, lambda: None)

    def _init(self, packet: Packet, level: int) -> None:
        self._end_levels()
        if packet.data != b"\0":
            self._ack(packet, PARAMETER)
            return

        def finish() -> None:
            works = self._board.high_voltage_works
            self._level = level if works else NO_LEVEL
            self._errors.clear()
            self._ack(packet, OK if works else HIGH_VOLTAGE)

        self._later(SWITCH_TIME_S, finish)

    def _stop(self, packet: Packet, level: int) -> None:
        result = OK if self._level == level else NOT_INITIALISED
        self._end_levels()
        self._later(SWITCH_TIME_S, lambda: self._ack(packet, result))

    def _ll_channel_config(self, packet: Packet) -> None:
        head = packet.data[0] if packet.data else 0
        execute, channel, connector = head >> 7, head >> 5 & 3, head >> 4 & 1
        points = parse_points(packet.data[1:], (head & 0xF) + 1)
        result, lasts_s = OK, 0.0
        if self._level != LOW_LEVEL:
            result = NOT_INITIALISED
        elif points is None:
            result = PARAMETER
        elif execute and not self.high_voltage_on:
            result = HIGH_VOLTAGE
        elif execute:
            flowed = self._board.electrodes.fire(self._board.timeline.now_s, points, (connector, channel))
            result = ELECTRODE if not flowed and largest_ma(points) >= ELECTRODE_DETECTION_MA else OK
            lasts_s = duration_s(points)
        answer = lambda: self._ack(packet, result, connector << 4 | channel, 0)  # noqa: E731
        if lasts_s:
            self._later(lasts_s, answer)
        else:
            answer()

    def _ml_update(self, packet: Packet) -> None:
        """Set each channel in the mask, stop the others."""
        if self._level != MID_LEVEL_READY:
            self._ack(packet, NOT_INITIALISED)
            return
        wanted = _parse_update(packet.data)
        if wanted is None:
            self._ack(packet, PARAMETER)
            return
        for number in self._channels.keys() - wanted:
            self._end(number)
        for number, channel in wanted.items():
            if running := self._channels.get(number):  # it keeps its timing
                running.period_s, running.points = channel.period_s, channel.points
            else:
                self._errors.pop(number, None)
                self._channels[number] = channel
                self._schedule(number, channel, self._board.timeline.now_s)
        if self._channels and self._silence is None:
            self._alive()
        self._ack(packet, OK)

    def _ml_get_current_data(self, packet: Packet) -> None:
        """The sign of life; its answer: result, selection, active mask, errors."""
        if self._level != MID_LEVEL_READY:
            self._ack(packet, NOT_INITIALISED, ALL_ERRORS, *bytes(5))
        elif packet.data != bytes((ALL_ERRORS,)):
            self._ack(packet, *bytes((PARAMETER, *packet.data[:1])).ljust(7, b"\0"))
        else:
            if self._channels:
                self._alive()
            active = sum(1 << number for number in self._channels)
            nibbles = sum(error << 4 * number for number, error in self._errors.items())
            result = ELECTRODE if self._errors else OK
            self._ack(packet, result, ALL_ERRORS, active, *nibbles.to_bytes(4, "little"))

    def _alive(self) -> None:
        cancel(self._silence)
        self._silence = self._board.timeline.after(SILENCE_S, self._silent)

    def _silent(self) -> None:
        for number in list(self._channels):
            self._end(number)
        self._silence = None

    def _schedule(self, number: int, channel: Channel, time_s: float) -> None:
        channel.next_pulse = self._board.timeline.at(time_s, lambda: self._fire(number, channel, time_s))

    def _fire(self, number: int, channel: Channel, time_s: float) -> None:
        board = self._board
        flowed = board.high_voltage_works and board.electrodes.fire(time_s, channel.points, (number >> 2, number & 3))
        if not flowed and largest_ma(channel.points) >= ELECTRODE_DETECTION_MA:
            self._errors[number] = ELECTRODE_NIBBLE
            self._end(number)
        else:
            self._schedule(number, channel, time_s + channel.period_s)

    def _end(self, number: int) -> None:
        cancel(self._channels.pop(number).next_pulse)
