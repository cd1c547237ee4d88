"""Hasomed RehaMove P24's firmware, ScienceMode 4: general commands, low level and mid level.

Low level: the host sends one LLChannelConfig per pulse. Silence means no stimulation. Mid level: the device repeats
each channel's pulse until the host changes or stops it. The host must send MLGetCurrentData at least every 2 s; silence
stops the stimulation. A real device may accept other commands as a sign of life. This one does not, so that a driver
that works here works there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

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
    """`count` points of u32 big endian, µs << 20 | (2·mA + 300) << 10; None if the length differs."""
    if len(data) != count * POINT_BYTES:
        return None
    words = (int.from_bytes(data[i : i + POINT_BYTES], "big") for i in range(0, len(data), POINT_BYTES))
    return [(word >> 20, ((word >> 10 & 0x3FF) - 300) / 2) for word in words]


def within_limits(points: Sequence[Point]) -> bool:
    """Return whether the device accepts this shape: currents within ±130 mA and some duration."""
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
        """True while any channel pulses."""
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


LL_INIT, LL_CHANNEL_CONFIG, LL_STOP = 0, 2, 4
ML_INIT, ML_UPDATE, ML_STOP, ML_GET_CURRENT_DATA = 30, 32, 34, 36
DEVICE_ID, RESET, STIM_STATUS, GENERAL_ERROR, UNKNOWN_COMMAND, EXTENDED_VERSION = 52, 58, 62, 66, 67, 68
SWITCH_TIME_S = 0.040
RESET_TIME_S = 0.2
HIGH_VOLTAGE_OFF, HIGH_VOLTAGE_ON_CODE = 1, 6
NO_LEVEL, LOW_LEVEL, MID_LEVEL_READY, MID_LEVEL_RUNNING = 0, 1, 2, 3
MODES = ("none", "low level", "mid level", "mid level running")
MEASUREMENT_SAMPLES = 128
LOAD_KILOOHM = 1.0
SOURCE_VOLT = 150.0


class P24(Firmware):
    """The P24's state machine; commands are done one after another, in the order they came."""

    device, wire = "P24", ScienceMode4

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self._queue: deque[Packet] = deque()
        self._doing: Event | None = None
        self._level = NO_LEVEL
        self._source = self._measurement = 0
        self._mid_level = MidLevel(board)
        self._handlers: dict[int, Callable[[Packet], None]] = {
            LL_INIT: self._ll_init,
            LL_CHANNEL_CONFIG: self._ll_channel_config,
            LL_STOP: lambda p: self._stop(p, LOW_LEVEL),
            ML_INIT: self._ml_init,
            ML_UPDATE: self._ml_update,
            ML_STOP: lambda p: self._stop(p, MID_LEVEL_READY),
            ML_GET_CURRENT_DATA: self._ml_get_current_data,
            DEVICE_ID: lambda p: self._ack(p, bytes((OK,)) + b"EMULATED24"),
            RESET: self._reset_command,
            STIM_STATUS: self._stim_status,
            # firmware 1.0.0, ScienceMode 4.0.0, hash 0 of kind git, valid
            EXTENDED_VERSION: lambda p: self._ack(p, bytes((OK, 1, 0, 0, 4, 0, 0, 0, 0, 0, 0, 1, 1))),
        }

    @property
    def level(self) -> int:
        """Stimulation status as the protocol counts it: 0 none, 1 low, 2 mid, 3 mid running."""
        if self._level == MID_LEVEL_READY and self._mid_level.running:
            return MID_LEVEL_RUNNING
        return self._level

    @property
    def high_voltage_on(self) -> bool:
        """True while the source that drives the pulses is on."""
        return self._level != NO_LEVEL and self._source != HIGH_VOLTAGE_OFF and self._board.high_voltage_works

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

    def state(self) -> dict[str, Any]:
        """For the control line."""
        return self._describe(MODES[self.level], self.high_voltage_on)

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

    def _ack(self, packet: Packet, data: bytes) -> None:
        self._send(packet.number, packet.command + 1, data)

    def _end_levels(self) -> None:
        self._mid_level.stop()
        self._level = NO_LEVEL

    def _unknown(self, packet: Packet) -> None:
        self._send(packet.number, UNKNOWN_COMMAND, bytes((INVALID_COMMAND,)))

    def _stim_status(self, packet: Packet) -> None:
        high_voltage = HIGH_VOLTAGE_ON_CODE if self.high_voltage_on else 0
        self._ack(packet, bytes((OK, self.level, high_voltage)))

    def _reset_command(self, packet: Packet) -> None:
        self._ack(packet, bytes((OK,)))
        self._end_levels()
        self._queue.clear()
        self._later(RESET_TIME_S, lambda: None)

    def _ll_init(self, packet: Packet) -> None:
        self._end_levels()
        settings = packet.data[0] if len(packet.data) == 1 else -1
        measurement, source = settings >> 4 & 7, settings >> 1 & 7
        if settings < 0 or settings & 0x81 or measurement > 3 or source > HIGH_VOLTAGE_ON_CODE:
            self._ack(packet, bytes((PARAMETER,)))
            return

        def finish() -> None:
            self._measurement, self._source = measurement, source
            works = self._board.high_voltage_works or source == HIGH_VOLTAGE_OFF
            self._level = LOW_LEVEL if works else NO_LEVEL
            self._ack(packet, bytes((OK if works else HIGH_VOLTAGE,)))

        self._later(SWITCH_TIME_S, finish)

    def _stop(self, packet: Packet, level: int) -> None:
        result = OK if self._level == level else NOT_INITIALISED
        self._end_levels()
        self._later(SWITCH_TIME_S, lambda: self._ack(packet, bytes((result,))))

    def _ll_channel_config(self, packet: Packet) -> None:
        head = packet.data[0] if packet.data else 0
        execute, channel, connector = head >> 7, head >> 5 & 3, head >> 4 & 1
        points = parse_points(packet.data[1:], (head & 0xF) + 1) if packet.data else None
        place = connector << 4 | channel

        def answer(result: int) -> None:
            measured = self._measurement if result == OK and execute and points else 0
            self._ack(packet, bytes((result, place, measured)) + self._samples(measured, points or []))

        if self._level != LOW_LEVEL:
            answer(NOT_INITIALISED)
        elif points is None or not within_limits(points):
            answer(PARAMETER)
        elif not execute:
            answer(OK)
        elif not self.high_voltage_on:
            answer(HIGH_VOLTAGE)
        else:
            flowed = self._board.electrodes.fire(self._board.timeline.now_s, points, (connector, channel), "low level")
            is_detected = max(abs(current_ma) for _, current_ma in points) >= ELECTRODE_DETECTION_MA
            result = ELECTRODE if is_detected and not flowed else OK
            self._later(sum(width for width, _ in points) * 1e-6, lambda: answer(result))

    @staticmethod
    def _samples(measurement: int, points: list[tuple[int, float]]) -> bytes:
        """Sampling time (µs) and 128 samples ×100 of current (1), voltage (2) or source voltage (3)."""
        if not measurement:
            return b""
        step_us = max(1, -(-sum(width for width, _ in points) // MEASUREMENT_SAMPLES))
        shape = [abs(current) for width, current in points for _ in range(width)][::step_us]
        shape = (shape + [0.0] * MEASUREMENT_SAMPLES)[:MEASUREMENT_SAMPLES]
        scale = {1: 1.0, 2: LOAD_KILOOHM, 3: 0.0}[measurement]
        constant = SOURCE_VOLT if measurement == 3 else 0.0
        values = [step_us, *(round(100 * (scale * sample + constant)) for sample in shape)]
        return b"".join(value.to_bytes(2, "big") for value in values)

    def _ml_init(self, packet: Packet) -> None:
        self._end_levels()
        if len(packet.data) != 1 or packet.data[0] > 1:
            self._ack(packet, bytes((PARAMETER,)))
            return
        if not self._board.high_voltage_works:
            self._ack(packet, bytes((HIGH_VOLTAGE,)))
            return

        def finish() -> None:
            self._level, self._source = MID_LEVEL_READY, 0
            self._mid_level.start(stop_on_error=bool(packet.data[0]))
            self._ack(packet, bytes((OK,)))

        self._later(SWITCH_TIME_S, finish)

    def _ml_update(self, packet: Packet) -> None:
        ready = self._level == MID_LEVEL_READY
        self._ack(packet, bytes((self._mid_level.update(packet.data) if ready else NOT_INITIALISED,)))

    def _ml_get_current_data(self, packet: Packet) -> None:
        if self._level != MID_LEVEL_READY:
            self._ack(packet, bytes((NOT_INITIALISED, 4, 0, 0, 0, 0, 0)))
        else:
            self._ack(packet, self._mid_level.current_data(packet.data))
