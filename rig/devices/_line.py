"""A serial line with numbered packets: a reader thread, one writer at a time, commands that wait for acks."""

from __future__ import annotations

import contextlib
import logging
import os
import termios
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import serial

from rig.clock import Clock
from rig.errors import DeviceError, WireError
from rig.signals import LateError
from rig.wire.framing import FrameReader, Packet

log = logging.getLogger("rig.line")

READ_TIMEOUT_S = 0.05
PSEUDO_TERMINALS = "/dev/pts/"


class PacketLine:
    """One serial port.

    Parameters
    ----------
    port
        Path of the port.
    numbers
        Number of packet numbers before they repeat.
    reader
        Makes a new reader of frames each time the port is opened.
    on_packet
        Called with each packet and the time at which it was read (rig clock); from the reader thread.
    arguments
        For `serial.Serial`: rate, parity, stop bits, flow control.
    """

    def __init__(
        self,
        port: str,
        clock: Clock,
        numbers: int,
        reader: Callable[[], FrameReader],
        on_packet: Callable[[Packet, float], None],
        **arguments: Any,
    ) -> None:
        self.port = port
        self.last_written_s = -1e9
        self._clock = clock
        self._numbers = numbers
        self._reader = reader
        self._on_packet = on_packet
        self._arguments = arguments
        self._serial: serial.Serial | None = None
        self._write_lock = threading.Lock()
        self._number = 0
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._answered = threading.Condition()
        self._waiting: dict[int, Packet | None] = {}
        self._lost = ""
        self._on_lost: Callable[[str], None] = lambda _: None

    def on_lost(self, action: Callable[[str], None]) -> None:
        """Register a callback for the loss of the line; called from the reader thread."""
        self._on_lost = action

    def open(self) -> None:
        """Open the port and start reading. Raises DeviceError, which names the port and says how to correct it."""
        if not Path(self.port).exists():
            raise DeviceError(f"stimulator.port: {self.port} is missing; plug in the stimulator or correct the port")
        try:
            self._serial = serial.Serial(self.port, timeout=READ_TIMEOUT_S, exclusive=True, **self._arguments)
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceError(
                f"stimulator.port: {self.port} cannot be opened ({error}); is another program using it?"
            ) from None
        self._refuse_fast_clock()
        self._closing.clear()
        self._lost = ""
        self._thread = threading.Thread(target=self._read, name="stimulator-acks", daemon=True)
        self._thread.start()

    def _refuse_fast_clock(self) -> None:
        """Limits are in rig seconds, so a clock faster than real time may be used with an emulator's port only."""
        assert self._serial is not None
        place = os.ttyname(self._serial.fileno())
        if self._clock.speed != 1.0 and not place.startswith(PSEUDO_TERMINALS):
            self.close()
            raise DeviceError(
                f"stimulator.port: {self.port} is {place}, a real device, and the rig's clock runs "
                f"{self._clock.speed:g} times as fast as real time; use a rig file"
            )

    def close(self) -> None:
        """End the thread and close the port; never raises."""
        self._closing.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)
        if self._serial is not None:
            with contextlib.suppress(OSError):  # closing an unplugged port fails
                self._serial.close()
            self._serial = None

    def discard(self) -> None:
        """Discard bytes that were written but still wait in this computer, as on a stalled line.

        Never raises. A frame that is cut by this is damaged, and the device drops it because of its checksum.
        """
        port = self._serial
        if port is not None:
            with contextlib.suppress(OSError, TypeError, ValueError, termios.error):
                termios.tcflush(port.fileno(), termios.TCOFLUSH)

    def tell(self, make: Callable[[int], bytes], latest_s: float | None = None) -> int:
        """Write the frame that `make` returns for the next packet number; returns the number.

        Raises
        ------
        LateError
            The clock had passed `latest_s` right before the write: nothing was written.
        DeviceError
            The line accepts no bytes, or the frame cannot be encoded.
        """
        with self._write_lock:
            number = self._next_number()
            try:
                frame = make(number)
            except WireError as error:
                raise DeviceError(f"stimulator {self.port}: the command cannot be encoded: {error}") from None
            self._write(frame, latest_s)
        return number

    def ask(self, make: Callable[[int], bytes], name: str, answer: int, timeout_s: float) -> Packet:
        """Write a command and wait for its ack.

        Parameters
        ----------
        name, answer
            Name of the command in messages, and the command number of its ack.
        timeout_s
            Real seconds.

        Raises
        ------
        DeviceError
            No ack in time, or an unexpected answer.
        """
        with self._write_lock:
            number = self._next_number()
            with self._answered:
                self._waiting[number] = None
            try:
                self._write(make(number))
            except DeviceError:
                with self._answered:
                    self._waiting.pop(number, None)
                raise
        with self._answered:
            self._answered.wait_for(lambda: self._waiting[number] is not None or bool(self._lost), timeout_s)
            packet = self._waiting.pop(number)
        if packet is None:
            why = self._lost or f"no answer in {timeout_s:g} s"
            raise DeviceError(f"stimulator {self.port}: {name}: {why}; check its power")
        if packet.command != answer:
            raise DeviceError(f"stimulator {self.port}: {name}: answered with command {packet.command}")
        return packet

    def _next_number(self) -> int:
        self._number = (self._number + 1) % self._numbers
        return self._number

    def _write(self, frame: bytes, latest_s: float | None = None) -> None:
        if self._serial is None or self._lost:
            raise DeviceError(f"stimulator {self.port} is not connected: {self._lost or 'not opened'}")
        if latest_s is not None and not (self._clock.now_s() <= latest_s):
            raise LateError
        try:
            # one system call: pyserial's write reports a timeout for a pulse that it has sent, if it was interrupted
            written = os.write(self._serial.fileno(), frame)
        except (serial.SerialException, OSError, TypeError) as error:
            raise DeviceError(f"stimulator {self.port} accepted no bytes: {error}") from None
        if written != len(frame):
            raise DeviceError(f"stimulator {self.port} accepted {written} of {len(frame)} bytes; check its power")
        self.last_written_s = self._clock.now_s()

    def _read(self) -> None:
        try:
            self._read_all()
        except Exception as error:  # a bug in a driver: report it at once, not after a timeout
            log.exception("the reader of %s failed", self.port)
            self._lose(f"internal: {type(error).__name__}: {error}")

    def _read_all(self) -> None:
        frames = self._reader()
        port = self._serial
        assert port is not None
        while not self._closing.is_set():
            try:
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
            except (serial.SerialException, OSError, TypeError) as error:
                # pyserial raises TypeError if the port is closed during a read
                if not self._closing.is_set():
                    self._lose(f"the connection was lost ({error})")
                return
            time_s = self._clock.now_s()
            for packet in frames.feed(data):
                self._on_packet(packet, time_s)
                self._answer(packet)

    def _answer(self, packet: Packet) -> None:
        with self._answered:
            if packet.number in self._waiting:
                self._waiting[packet.number] = packet
                self._answered.notify_all()

    def _lose(self, reason: str) -> None:
        with self._answered:
            self._lost = reason
            self._answered.notify_all()
        self._on_lost(f"stimulator {self.port}: {reason}")
