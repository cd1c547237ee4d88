"""A serial line that speaks in numbered packets: a reader thread, one writer at a time, commands that wait for acks."""

from __future__ import annotations

import contextlib
import logging
import os
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import serial

from rig.clock import Clock
from rig.errors import DeviceError, WireError
from rig.signals import LateError
from rig.wire.sciencemode4 import Packet

log = logging.getLogger("rig.line")

READ_TIMEOUT_S = 0.05
PSEUDO_TERMINALS = "/dev/pts/"


class Reader(Protocol):
    """Bytes to packets."""

    def feed(self, data: bytes) -> Iterator[Packet]: ...


class PacketLine:
    """One serial port.

    Parameters
    ----------
    port
        Path of the port.
    numbers
        How many packet numbers there are before they come again.
    reader
        Makes a new `Reader` for each opening.
    on_packet
        Takes each packet and the time at which it had been read (rig clock); from the reader thread.
    arguments
        Of `serial.Serial`: rate, parity, stop bits, flow control.
    """

    def __init__(
        self,
        port: str,
        clock: Clock,
        numbers: int,
        reader: Callable[[], Reader],
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
        """Say who is told, from the reader thread, when the line breaks."""
        self._on_lost = action

    def open(self) -> None:
        """Open the port and begin to read. Raises DeviceError naming the port and the mend."""
        if not Path(self.port).exists():
            raise DeviceError(f"stimulator.port: {self.port} is not there; plug the stimulator in or correct the port")
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
        """Limits are in rig seconds: a clock that runs faster than the world may drive an emulator's port only."""
        assert self._serial is not None
        place = os.ttyname(self._serial.fileno())
        if self._clock.speed != 1.0 and not place.startswith(PSEUDO_TERMINALS):
            self.close()
            raise DeviceError(
                f"stimulator.port: {self.port} is {place}, a real device, and the rig's clock runs "
                f"{self._clock.speed:g} times as fast as the world; use a rig file"
            )

    def close(self) -> None:
        """End the thread and give the port back; never raises."""
        self._closing.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)
        if self._serial is not None:
            with contextlib.suppress(OSError):  # an unplugged line cannot be given back
                self._serial.close()
            self._serial = None

    def discard(self) -> None:
        """Throw away what was written and still waits in this computer: a line that takes nothing holds it there.

        Never raises. A frame that is cut in two by this is damaged, and the device drops it by its checksum.
        """
        port = self._serial
        if port is not None:
            with contextlib.suppress(OSError, TypeError, ValueError, termios.error):
                termios.tcflush(port.fileno(), termios.TCOFLUSH)

    def tell(self, make: Callable[[int], bytes], latest_s: float | None = None) -> int:
        """Write the frame that `make` gives for the next number; the number.

        Raises
        ------
        LateError
            The clock had passed `latest_s` right before the write: nothing was written.
        DeviceError
            The line takes no bytes, or the frame cannot be made.
        """
        with self._write_lock:
            number = self._next_number()
            try:
                frame = make(number)
            except WireError as error:
                raise DeviceError(f"stimulator {self.port}: cannot be sent: {error}") from None
            self._write(frame, latest_s)
        return number

    def ask(self, make: Callable[[int], bytes], name: str, answer: int, timeout_s: float) -> Packet:
        """Write a command and wait for its ack.

        Parameters
        ----------
        name, answer
            What people call the command, and the command number of its ack.
        timeout_s
            Real seconds.

        Raises
        ------
        DeviceError
            No ack in time, or another answer.
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
            raise DeviceError(f"stimulator {self.port}: {name}: {why}; is it switched on?")
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
            # one system call: pyserial's own write calls a pulse that went out late-scheduled a timeout
            written = os.write(self._serial.fileno(), frame)
        except (serial.SerialException, OSError, TypeError) as error:
            raise DeviceError(f"stimulator {self.port} took no bytes: {error}") from None
        if written != len(frame):
            raise DeviceError(f"stimulator {self.port} took {written} of {len(frame)} bytes; is it still reading?")
        self.last_written_s = self._clock.now_s()

    def _read(self) -> None:
        try:
            self._read_all()
        except Exception as error:  # a mistake in a driver: told at once, not only by acks that do not come
            log.exception("the reader of %s broke", self.port)
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
                # TypeError: pyserial's answer to a port closed under a read
                if not self._closing.is_set():
                    self._lose(f"the line broke ({error})")
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
