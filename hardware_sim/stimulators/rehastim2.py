"""Hasomed RehaStim 2's firmware, ScienceMode 2: connection, watchdog, single pulses and the channel list.

The device offers a connection (Init) every 500 ms until the host accepts it (InitAck). From then on, 1200 ms without a
valid command end everything: stimulation, modes and the connection. Until then a started channel list goes on pulsing
by itself, even if the host is dead.

Where its documentation is silent this firmware is strict, so that a driver that works here works on the device: without
a connection commands are neither obeyed nor answered, and Init comes again after the watchdog has expired. Odd currents
are rounded down to a multiple of 2 mA. Of channel lists it takes single pulses at one period; low-frequency channels,
doublets, triplets and lists that play once are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from stimrig.hardware_sim.stimulators.board import Board, Firmware
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2
from stimrig.hardware_sim.timeline import Event, cancel

OK, PARAMETER = 0, -2
NO_ERROR, EMERGENCY_SWITCH, ELECTRODE, MODULE = 0, -1, -2, -3
CHANNELS = 8
SHORTEST_US, LONGEST_US = 20, 500
LARGEST_MA, STEP_MA = 126, 2
GAP_US = 100
SHORTEST_INTERVAL_S = 0.008


class Pulse(NamedTuple):
    """A symmetric biphasic pulse: the width of each phase and its current."""

    width_us: int
    current_ma: int


def parse_pulse(data: bytes) -> Pulse | None:
    """Width u16 and mA; None outside the device's limits. Odd currents are rounded down."""
    width_us, current_ma = int.from_bytes(data[:2], "big"), data[2]
    if not (SHORTEST_US <= width_us <= LONGEST_US and current_ma <= LARGEST_MA):
        return None
    return Pulse(width_us, current_ma - current_ma % STEP_MA)


def parse_init(data: bytes) -> tuple[tuple[int, ...], float] | None:
    """InitChannelList: factor, active mask, low-frequency mask, interpulse code, period code u16, execution.

    The channels and their period, s. Execution other than 0 is refused, since its meaning is not known.
    """
    if len(data) != 7 or data[0] or not data[1] or data[2] or data[6]:
        return None
    interpulse_s, period_s = 0.5e-3 * data[3] + 1.5e-3, 0.5e-3 * int.from_bytes(data[4:6], "big") + 1e-3
    if min(interpulse_s, period_s) < SHORTEST_INTERVAL_S:
        return None
    return tuple(channel for channel in range(CHANNELS) if data[1] >> channel & 1), period_s


def parse_start(data: bytes, channels: tuple[int, ...]) -> dict[int, Pulse] | None:
    """Start or Update: mode (0, single pulses), width u16, mA for each active channel, in their order."""
    if len(data) != 4 * len(channels):
        return None
    rows = [data[at : at + 4] for at in range(0, len(data), 4)]
    pulses = {channel: pulse for channel, row in zip(channels, rows, strict=True) if (pulse := parse_pulse(row[1:]))}
    return pulses if len(pulses) == len(channels) and not any(row[0] for row in rows) else None


def fire(board: Board, time_s: float, channel: int, pulse: Pulse) -> int:
    """Fire one pulse at one output; returns 0 or the error for StimulationError."""
    if board.electrodes.cut:
        return EMERGENCY_SWITCH
    if not board.high_voltage_works:
        return MODULE
    if pulse.current_ma == 0:
        return NO_ERROR
    points = [(pulse.width_us, pulse.current_ma), (GAP_US, 0), (pulse.width_us, -pulse.current_ma)]
    return NO_ERROR if board.electrodes.fire(time_s, points, (channel >> 2, channel & 3)) else ELECTRODE


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
        self._channels: tuple[int, ...] = ()
        self._period_s = SHORTEST_INTERVAL_S
        self._pulses: dict[int, Pulse] = {}
        self._next_group: Event | None = None
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

    def mode(self) -> tuple[str, bool]:
        """Its mode, and whether the channel list runs."""
        return MODES[self._mode], self._mode == STARTED

    def _connect(self, packet: Packet) -> None:
        """Accept an InitAck if it answers an Init that was sent since the connection was lost."""
        if self._mode != NOT_CONNECTED or packet.number not in self._offered or packet.data != bytes((OK,)):
            return
        cancel(self._offer)
        self._mode = START_MODE
        self._alive()

    def _disconnect(self) -> None:
        self._end_list()
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
        self._end_list()
        self._mode = START_MODE
        self._send_event(STIMULATION_ERROR, bytes((error & 0xFF,)))

    def _init_channel_list(self, packet: Packet) -> None:
        wanted = parse_init(packet.data)
        if self._mode == STARTED:
            self._ack(packet, WRONG_MODE)
        elif wanted is None:
            self._ack(packet, PARAMETER)
        else:
            self._end_list()
            self._channels, self._period_s = wanted
            self._mode = INITIALISED
            self._ack(packet, OK)

    def _start(self, packet: Packet) -> None:
        """Start, or Update if the list runs already: the timing of its pulses goes on."""
        if self._mode == START_MODE:
            self._ack(packet, WRONG_MODE)
            return
        pulses = parse_start(packet.data, self._channels)
        if pulses is None:
            self._ack(packet, PARAMETER)
        else:
            self._mode = STARTED
            self._ack(packet, OK)
            self._pulses = pulses  # of the next group on, if the list runs already
            if self._next_group is None:
                self._fire_group(self._board.timeline.now_s)

    def _fire_group(self, time_s: float) -> None:
        next_s = time_s + self._period_s
        self._next_group = self._board.timeline.at(next_s, lambda: self._fire_group(next_s))
        for channel, pulse in self._pulses.items():
            if error := fire(self._board, time_s, channel, pulse):
                self._stimulation_failed(error)  # it ends the list
                return

    def _end_list(self) -> None:
        cancel(self._next_group)
        self._next_group = None

    def _stop(self, packet: Packet) -> None:
        self._end_list()
        self._mode = START_MODE
        self._ack(packet, OK)

    def _single_pulse(self, packet: Packet) -> None:
        data, now_s = packet.data, self._board.timeline.now_s
        pulse = parse_pulse(data[1:]) if len(data) == 4 and data[0] < CHANNELS else None
        if self._mode != START_MODE:
            self._ack(packet, WRONG_MODE)
        elif pulse is None:
            self._ack(packet, PARAMETER)
        elif now_s < self._single_ends_s:
            self._ack(packet, BUSY)
        else:
            self._ack(packet, OK)
            self._single_ends_s = now_s + (2 * pulse.width_us + GAP_US) * 1e-6
            if error := fire(self._board, now_s, data[0], pulse):
                self._stimulation_failed(error)
