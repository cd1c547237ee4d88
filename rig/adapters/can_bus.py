"""A CAN adapter by python-can, opened once for all devices that hang on it, with a thread that reads it.

Some adapters can be opened only once (slcan). So the first device that opens one reads it for all.
"""

from __future__ import annotations

import contextlib
import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import can
import serial
from can.interfaces.slcan import slcanBus

from stimrig.rig.clock import Clock
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Frame, Listener


class ReadAhead:
    """A serial port: reads whatever waits at once and hands it out; everything else is the port's own.

    python-can's slcan asks the operating system for every single byte. That costs most of what a frame costs: with text
    frames at 1600 Hz it took a third of a processor, and on a busy machine the reader fell behind the cell.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._bytes = b""
        self._returned = 0

    @property
    def in_waiting(self) -> int:
        return len(self._bytes) - self._returned or self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes; waits for the port's own timeout if none is there."""
        if self._returned == len(self._bytes):
            self._bytes, self._returned = self._port.read(max(1, self._port.in_waiting)), 0
        part = self._bytes[self._returned : self._returned + size]
        self._returned += len(part)
        return part

    def reset_input_buffer(self) -> None:
        """Forget what was not read yet."""
        self._bytes, self._returned = b"", 0
        self._port.reset_input_buffer()

    @property
    def write_timeout(self) -> float | None:
        return self._port.write_timeout

    @write_timeout.setter
    def write_timeout(self, timeout_s: float | None) -> None:
        self._port.write_timeout = timeout_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)


ATTEMPTS = 5
STAMPING = ("socketcand", "socketcan", "pcan", "kvaser", "ixxat", "vector")
"""Timestamps of these interfaces are the sender's or the kernel's, of the others the host's at reading."""
READ_TIMEOUT_S = 0.02
GATHER_S = 0.005
"""Real seconds for which frames are gathered after the first one."""
JOIN_S = 2.0
SO_RCVBUFFORCE = 33
BUFFER_BYTES = 4_000_000
"""About 5000 frames: three seconds of a cell at 1600 samples/s."""

_open: dict[tuple[str, ...], CanBus] = {}
_registering = threading.Lock()


class CanBus:
    """See `stimrig.rig.machine.Bus`.

    `arguments`: of can.Bus. `name`: of the device that opens it, in words; with `_` it is its table in the rig file.
    """

    def __init__(
        self, arguments: dict[str, Any], name: str, clock: Clock, post: Callable[[Callable[[], None]], None]
    ) -> None:
        self._name, self._clock, self._post = name, clock, post
        self._key, self.place = _key(arguments), place_of(arguments)
        self._arguments = dict(arguments)
        self._listening: tuple[Listener, ...] = ()
        self._gathered: list[tuple[Listener, Frame]] = []
        self._gathered_until_s, self._damaged, self._errors = math.inf, 0, 0
        self._stamped = arguments.get("interface") in STAMPING
        self._tells_length = arguments.get("interface") != "socketcand"
        """True where a frame's identifier length is certain; some gateways write all identifiers with eight digits."""
        # python-can warns about every frame that is split between two packets, which is normal
        logging.getLogger("can").setLevel(logging.CRITICAL)
        self.can = self._opened()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"{name} bus", daemon=True)
        self._thread.start()
        with _registering:
            _open[self._key] = self

    @staticmethod
    def find(arguments: dict[str, Any], name: str) -> CanBus | None:
        """An adapter that is open already; None: it is not. Raises DeviceError if it is open with other arguments."""
        with _registering:
            bus = _open.get(_key(arguments))
        if bus is not None and bus._arguments != arguments:
            raise DeviceError(
                f"{_table(name)}.bus: {bus.place} is already open with other arguments; give the same as for the "
                f"{bus._name}, or leave it out"
            )
        return bus

    def listen(self, listener: Listener) -> None:
        self._listening = (*self._listening, listener)

    def detach(self, listener: Listener) -> None:
        self._listening = tuple(other for other in self._listening if other is not listener)

    def send(self, frames: Sequence[tuple[int, bytes, bool]]) -> None:
        for frame_id, data, is_extended in frames:
            message = can.Message(arbitration_id=frame_id, data=data, is_extended_id=is_extended)
            try:
                self.can.send(message, timeout=0.5)
            except (can.CanError, OSError) as error:
                frame = f"{frame_id:0{8 if is_extended else 3}X}#{data.hex()}"
                raise DeviceError(f"{self._name} on {self.place}: frame {frame} not sent: {_line(error)}") from None

    def close(self) -> None:
        with _registering:
            if _open.get(self._key) is self:
                del _open[self._key]
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
        self._lose(f"{self._name} on {self.place}: the bus was closed")
        with contextlib.suppress(Exception):
            self.can.shutdown()

    def _lose(self, reason: str) -> None:
        listening, self._listening = self._listening, ()
        for listener in listening:
            self._post(lambda lost=listener.lost: lost(reason))

    def _read(self) -> None:
        while not self._closing.is_set():
            try:
                self._read_once()
            except (can.CanError, OSError) as error:
                self._lose(f"{self._name} on {self.place}: the bus was lost: {_line(error)}")
                return
            except Exception as error:
                self._lose(f"{self._name} on {self.place}: reading failed: {_line(error)}")
                return

    def _read_once(self) -> None:
        try:
            message = self.can.recv(max(0.0, min(READ_TIMEOUT_S, self._gathered_until_s - time.monotonic())))
        except ValueError:  # slcan: a damaged line
            message = None
            self._damaged += 1
        if message is not None:
            self._sort(message)
        if self._damaged or self._errors or time.monotonic() >= self._gathered_until_s:
            self._hand_over()

    def _sort(self, message: can.Message) -> None:
        if message.is_error_frame:
            self._errors += 1
        elif not message.is_remote_frame:
            stamp_s = message.timestamp if self._stamped else math.nan
            frame = Frame(message.arbitration_id, bytes(message.data), self._clock.now_s(), stamp_s)
            for listener in self._listening:
                same_length = message.is_extended_id == listener.is_extended or not self._tells_length
                if listener.frame_id == message.arbitration_id and same_length:
                    self._gathered.append((listener, frame))
                    self._gathered_until_s = min(self._gathered_until_s, time.monotonic() + GATHER_S)

    def _hand_over(self) -> None:
        """Decode and post what was gathered; counts that belong to no identifier go to who opened the bus."""
        gathered, counts = self._gathered, (self._damaged, self._errors)
        self._gathered, self._gathered_until_s, self._damaged, self._errors = [], math.inf, 0, 0
        for number, listener in enumerate(self._listening):
            frames = [frame for of, frame in gathered if of is listener]
            damaged, errors = counts if number == 0 else (0, 0)
            if frames or damaged or errors:
                block = listener.decode(frames, damaged, errors)
                self._post(lambda handle=listener.handle, block=block: handle(block))

    def _opened(self) -> can.BusABC:
        self._probe()
        arguments = dict(self._arguments)
        if arguments.get("interface") == "slcan":
            arguments.setdefault("sleep_after_open", 0)
        last: Exception | None = None
        for _ in range(ATTEMPTS):
            try:
                bus = can.Bus(**arguments)
            except can.CanError as error:
                # the server's greeting and the first frame may share a packet, which aborts the handshake
                last = error
                time.sleep(0.05)
                continue
            except Exception as error:
                last = error
                break
            _size_buffer(bus)
            if isinstance(bus, slcanBus) and isinstance(bus.serialPortOrig, serial.Serial):
                bus.serialPortOrig = cast("Any", ReadAhead(bus.serialPortOrig))
            return bus
        raise DeviceError(f"{_table(self._name)}.bus: {self.place} cannot be opened: {_line(last)}")

    def _probe(self) -> None:
        """Fail early if no server answers: python-can itself would retry for ten seconds."""
        if self._arguments.get("interface") != "socketcand":
            return
        host, port = self._arguments.get("host"), self._arguments.get("port")
        try:
            socket.create_connection((str(host), int(str(port))), timeout=2.0).close()
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"{_table(self._name)}.bus: no socketcand answers at {host}:{port} ({_line(error)}); check that it is "
                "running"
            ) from None


def _size_buffer(bus: can.BusABC) -> None:
    """Room in the kernel for the frames of a pause: by default SocketCAN keeps about 300, a fifth of a second's."""
    line = getattr(bus, "socket", None)
    if isinstance(line, socket.socket):
        for option in (SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first needs a right, the second has a limit
            with contextlib.suppress(OSError):
                line.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
                return


def place_of(arguments: dict[str, Any]) -> str:
    """Return the name of an adapter in messages."""
    where = arguments.get("channel", "")
    if "host" in arguments:
        where = f"{where}@{arguments['host']}:{arguments.get('port')}"
    return f"{arguments.get('interface', 'default interface')} {where}".strip()


def _key(arguments: dict[str, Any]) -> tuple[str, ...]:
    return tuple(str(arguments.get(name, "")) for name in ("interface", "channel", "host", "port"))


def _table(name: str) -> str:
    return name.replace(" ", "_")


def _line(error: Exception | None) -> str:
    return " ".join(str(error).split())
