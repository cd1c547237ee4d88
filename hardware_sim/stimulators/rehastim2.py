"""Hasomed RehaStim 2's firmware, ScienceMode 2: connection, watchdog and single pulses. The channel list is in
`rehastim2_channels`.

The device offers a connection (Init) every 500 ms until the host accepts it (InitAck). From then on, 1200 ms without a
valid command end everything: stimulation, modes and the connection. Until then a started channel list goes on pulsing
by itself, even if the host is dead.

Where its documentation is silent this firmware is strict, so that a driver that works here works on the device: without
a connection commands are neither obeyed nor answered, and Init comes again after the watchdog has expired. Odd currents
are rounded down to a multiple of 2 mA.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stimrig.hardware_sim.stimulators.board import Board, Firmware
from stimrig.hardware_sim.stimulators.rehastim2_channels import (
    CHANNELS,
    NO_ERROR,
    OK,
    PARAMETER,
    ChannelList,
    Pulse,
    fire,
    parse_init,
    parse_pulse,
    parse_start,
)
from stimrig.hardware_sim.stimulators.sciencemode import Packet, ScienceMode2
from stimrig.hardware_sim.timeline import Event, cancel

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
            self._say(INIT, bytes((PROTOCOL_VERSION,)))
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

    def _say(self, command: int, data: bytes) -> None:
        """Send a packet that answers no command, with the device's own packet number."""
        self._send(self._number, command, data)
        self._number = (self._number + 1) & 0xFF

    def _stimulation_failed(self, error: int) -> None:
        """Stop, go back to start mode and report the error."""
        self._channels.stop()
        self._mode = START_MODE
        self._say(STIMULATION_ERROR, bytes((error & 0xFF,)))

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
