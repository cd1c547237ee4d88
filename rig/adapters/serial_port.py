"""A serial port by pyserial, with a thread that reads it."""

from __future__ import annotations

import contextlib
import os
import termios
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import serial

from stimrig.rig.clock import Clock
from stimrig.rig.errors import DeviceError

READ_TIMEOUT_S = 0.05
PSEUDO_TERMINALS = "/dev/pts/"

Post = Callable[[Callable[[], None]], None]


class SerialPort:
    """See `stimrig.rig.machine.Port`."""

    def __init__(self, path: str, clock: Clock, post: Post, **arguments: Any) -> None:
        self.port, self._clock, self._post, self._arguments = path, clock, post, arguments
        self._serial: serial.Serial | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()

    def open(self, on_bytes: Callable[[bytes, float], None], on_lost: Callable[[str], None]) -> None:
        if not Path(self.port).exists():
            raise DeviceError(f"stimulator.port: {self.port} is missing; plug in the stimulator or correct the port")
        try:
            port = serial.Serial(self.port, timeout=READ_TIMEOUT_S, exclusive=True, **self._arguments)
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceError(
                f"stimulator.port: {self.port} cannot be opened ({error}); is another program using it?"
            ) from None
        self._serial = port
        self._refuse_fast_clock(port)
        self._closing = threading.Event()
        arguments = port, self._closing, on_bytes, on_lost
        self._thread = threading.Thread(target=self._read, args=arguments, name="stimulator-reader", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        if self._serial is None:
            raise OSError("not opened")
        # one system call: pyserial's write reports a timeout for a pulse that it has sent, if it was interrupted
        return os.write(self._serial.fileno(), data)

    def discard(self) -> None:
        if self._serial is not None:
            with contextlib.suppress(OSError, TypeError, ValueError, termios.error):
                termios.tcflush(self._serial.fileno(), termios.TCOFLUSH)

    def close(self) -> None:
        self._closing.set()
        port, self._serial = self._serial, None
        if port is not None:
            with contextlib.suppress(Exception):
                port.cancel_read()
            if self._thread is not None:
                self._thread.join(timeout=1.0)
            with contextlib.suppress(OSError):  # closing an unplugged port fails
                port.close()

    def _refuse_fast_clock(self, port: serial.Serial) -> None:
        """Limits are in rig seconds, so a clock faster than real time may be used with an emulator's port only."""
        place = os.ttyname(port.fileno())
        if self._clock.speed != 1.0 and not place.startswith(PSEUDO_TERMINALS):
            self.close()
            raise DeviceError(
                f"stimulator.port: {self.port} is {place}, a real device, and the rig's clock runs "
                f"{self._clock.speed:g} times as fast as real time; use a rig file"
            )

    def _read(
        self,
        port: serial.Serial,
        closing: threading.Event,
        on_bytes: Callable[[bytes, float], None],
        on_lost: Callable[[str], None],
    ) -> None:
        while not closing.is_set():
            try:
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
            except (serial.SerialException, OSError, TypeError) as error:
                # pyserial raises TypeError if the port is closed during a read
                if not closing.is_set():
                    self._post(partial(on_lost, f"the connection was lost ({error})"))
                return
            if data:
                read_s = self._clock.now_s()
                self._post(partial(on_bytes, data, read_s))
