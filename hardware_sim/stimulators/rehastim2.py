"""Hasomed RehaStim 2's firmware, ScienceMode 2: connection, watchdog, single pulses and the channel list.

The device offers a connection (Init) every 500 ms until the host accepts it (InitAck). From then on, 1200 ms without a
valid command end everything: stimulation, modes and the connection. Until then a started channel list goes on pulsing
by itself, even if the host is dead.

Where its documentation is silent this firmware is strict, so that a driver that works here works on the device: without
a connection commands are neither obeyed nor answered, and Init comes again after the watchdog has expired. Odd currents
are rounded down to a multiple of 2 mA.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from stimrig.hardware_sim.stimulators.board import Board, Firmware, Point
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2
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
        """True while the group of an earlier Start still runs."""
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


INIT, INIT_ACK, UNKNOWN_COMMAND, WATCHDOG = 1, 2, 3, 4
GET_MODE, INIT_CHANNEL_LIST, START, STOP, SINGLE_PULSE, STIMULATION_ERROR = 10, 30, 32, 34, 36, 38
TRANSFER, WRONG_MODE, BUSY = -1, -3, -8
PROTOCOL_VERSION = 1
INIT_PERIOD_S = 0.5
WATCHDOG_S = 1.2
NOT_CONNECTED, START_MODE, INITIALISED, STARTED = -1, 0, 1, 2
MODES = {NOT_CONNECTED: "none", START_MODE: "start", INITIALISED: "initialised", STARTED: "started"}


class RehaStim2(Firmware):
    """The RehaStim 2's state machine; each command is executed and acknowledged when it arrives."""

    device, wire = "RehaStim 2", ScienceMode2

    def __init__(self, board: Board) -> None:
        super().__init__(board)
        self._channels = ChannelList(board, self._stimulation_failed)
        self._handlers: dict[int, Callable[[Packet], None]] = {
            WATCHDOG: lambda _packet: None,
            GET_MODE: lambda packet: self._ack(packet, OK, bytes((self._mode,))),
            INIT_CHANNEL_LIST: self._init_channel_list,
            START: self._start,
            STOP: self._stop,
            SINGLE_PULSE: self._single_pulse,
        }
        self._offer: Event | None = None
        self._watchdog: Event | None = None
        self.reset()

    def received(self, data: bytes) -> None:
        """Bytes from the host; a damaged command that can still be read is answered with a transfer error."""
        for packet in self._wire.feed(data, self._board.timeline.now_s):
            self.commands[packet.command] += 1
            if packet.command == INIT_ACK:
                self._connect(packet)
            elif self._mode != NOT_CONNECTED:
                self._obey(packet)
        for packet in self._wire.take_damaged():
            if self._mode != NOT_CONNECTED and packet.command in self._handlers and packet.command != WATCHDOG:
                self._ack(packet, TRANSFER)

    def reset(self) -> None:
        """Power lost and back: no stimulation, no connection; Init from number 0."""
        self._wire = self.wire()
        self._number = 0
        self._single_ends_s = 0.0
        self._disconnect()

    def state(self) -> dict[str, Any]:
        """For the control line."""
        return self._describe(MODES[self._mode], self._mode == STARTED)

    def _connect(self, packet: Packet) -> None:
        """Accept an InitAck if it answers an Init that was sent since the connection was lost."""
        if self._mode != NOT_CONNECTED or packet.number not in self._offered or packet.data != bytes((OK,)):
            return
        cancel(self._offer)
        self._mode = START_MODE
        self._alive()

    def _disconnect(self) -> None:
        self._channels.stop()
        self._mode = NOT_CONNECTED
        self._offered: set[int] = set()
        cancel(self._offer, self._watchdog)
        self._offer = self._board.timeline.after(INIT_PERIOD_S, self._offer_connection)

    def _offer_connection(self) -> None:
        if self._board.unread() == 0:  # on hardware a closed port drops it; here it would wait for the next client
            self._offered.add(self._number)
            self._send_event(INIT, bytes((PROTOCOL_VERSION,)))
        self._offer = self._board.timeline.after(INIT_PERIOD_S, self._offer_connection)

    def _alive(self) -> None:
        cancel(self._watchdog)
        self._watchdog = self._board.timeline.after(WATCHDOG_S, self._disconnect)

    def _obey(self, packet: Packet) -> None:
        handler = self._handlers.get(packet.command)
        if handler is None:
            self._send(packet.number, UNKNOWN_COMMAND, b"")
            return
        self._alive()
        handler(packet)

    def _ack(self, packet: Packet, result: int, data: bytes = b"") -> None:
        self._send(packet.number, packet.command + 1, bytes((result & 0xFF,)) + data)

    def _send_event(self, command: int, data: bytes) -> None:
        """Send a packet that answers no command, with the device's own packet number."""
        self._send(self._number, command, data)
        self._number = (self._number + 1) & 0xFF

    def _stimulation_failed(self, error: int) -> None:
        """Stop, go back to start mode and report the error."""
        self._channels.stop()
        self._mode = START_MODE
        self._send_event(STIMULATION_ERROR, bytes((error & 0xFF,)))

    def _init_channel_list(self, packet: Packet) -> None:
        wanted = parse_init(packet.data)
        if self._mode == STARTED:
            self._ack(packet, WRONG_MODE)
        elif wanted is None:
            self._ack(packet, PARAMETER)
        else:
            self._channels.set_up(wanted)
            self._mode = INITIALISED
            self._ack(packet, OK)

    def _start(self, packet: Packet) -> None:
        """Start, or Update if the list runs already: the timing of its pulses goes on."""
        if self._mode == START_MODE:
            self._ack(packet, WRONG_MODE)
            return
        pulses = parse_start(packet.data, self._channels.setup)
        if pulses is None:
            self._ack(packet, PARAMETER)
        elif self._channels.one_shot_runs:
            self._ack(packet, BUSY)
        else:
            self._mode = STARTED
            self._ack(packet, OK)
            self._channels.start(pulses)

    def _stop(self, packet: Packet) -> None:
        self._channels.stop()
        self._mode = START_MODE
        self._ack(packet, OK)

    def _single_pulse(self, packet: Packet) -> None:
        channel, pulse = self._parse_single(packet.data)
        now_s = self._board.timeline.now_s
        if self._mode != START_MODE:
            self._ack(packet, WRONG_MODE)
        elif pulse is None:
            self._ack(packet, PARAMETER)
        elif now_s < self._single_ends_s:
            self._ack(packet, BUSY)
        else:
            self._ack(packet, OK)
            self._single_ends_s = now_s + pulse.duration_s
            error = fire(self._board, now_s, channel, pulse, "single pulse")
            if error != NO_ERROR:
                self._stimulation_failed(error)

    @staticmethod
    def _parse_single(data: bytes) -> tuple[int, Pulse | None]:
        if len(data) != 4 or data[0] >= CHANNELS:
            return 0, None
        return data[0], parse_pulse(data[1:])
