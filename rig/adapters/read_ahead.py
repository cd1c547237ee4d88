"""A serial port whose waiting bytes are taken in one call, for readers that ask for one byte at a time.

python-can's slcan asks the operating system for every single byte. That costs most of what a frame costs: with text
frames at 1600 Hz it took a third of a processor, and on a busy machine the reader fell behind the cell.
"""

from __future__ import annotations

from typing import Any


class ReadAhead:
    """Reads whatever waits at once and hands it out; everything else is the port's own.

    Parameters
    ----------
    port
        An open `serial.Serial`, or what behaves like one.
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self._bytes = b""
        self._given = 0

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read without waiting."""
        return len(self._bytes) - self._given or self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        """At most `size` bytes; waits for the port's own timeout if none is there."""
        if self._given == len(self._bytes):
            self._bytes, self._given = self._port.read(max(1, self._port.in_waiting)), 0
        part = self._bytes[self._given : self._given + size]
        self._given += len(part)
        return part

    def reset_input_buffer(self) -> None:
        """Forget what was not read yet."""
        self._bytes, self._given = b"", 0
        self._port.reset_input_buffer()

    @property
    def write_timeout(self) -> float | None:
        """Seconds that a write may take; None: no limit."""
        return self._port.write_timeout

    @write_timeout.setter
    def write_timeout(self, timeout_s: float | None) -> None:
        self._port.write_timeout = timeout_s

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)
