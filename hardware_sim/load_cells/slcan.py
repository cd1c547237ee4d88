"""The usual USB adapter's protocol (slcan, after LAWICEL) on a pseudo-terminal: `t181 8 …\\r` without blanks.

Accepts S0-S8, s, O, L, C, V, N, F, Z, t and T, and empty lines. Frames pass between O (or L) and C.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stimrig.hardware_sim.load_cells.frames import LARGEST_STANDARD_ID, Frame, FrameHandler
from stimrig.hardware_sim.ports import PseudoTerminal, Reactor

OK, ERROR = b"\r", b"\a"
LONGEST_LINE = 64


class Slcan:
    """One adapter on one port; it does not know whether a client has the port open."""

    def __init__(self, reactor: Reactor, on_frame: FrameHandler) -> None:
        self._reactor, self._on_frame = reactor, on_frame
        self._port = PseudoTerminal()
        self._line = b""
        self._open = self._listen_only = False
        reactor.add(self._port, self._read)
        self.can: dict[str, Any] = {"interface": "slcan", "channel": self._port.path, "sleep_after_open": 0}

    def send(self, frames: Sequence[Frame]) -> None:
        """Frames to the port while the channel is open; the protocol cannot report bus errors."""
        if self._open:
            for frame in frames:
                if not frame.error:
                    self._port.write(_line(frame))
        self._port.flush()

    def close(self) -> None:
        """Pull the adapter out."""
        if self._port.is_open:
            self._reactor.unregister(self._port)
            self._port.close()

    def _read(self) -> None:
        *lines, self._line = (self._line + self._port.read()).split(b"\r")
        self._line = self._line[-LONGEST_LINE:]
        for line in lines:
            self._port.write(self._obey(line.strip(b"\n")))

    def _obey(self, line: bytes) -> bytes:
        letter = line[:1]
        if letter in (b"O", b"L", b"C"):
            self._open, self._listen_only = letter != b"C", letter == b"L"
            return OK
        if letter in (b"t", b"T"):
            return self._transmit(line)
        answers = {b"": OK, b"S": OK, b"s": OK, b"Z": OK, b"V": b"V1013\r", b"N": b"NEMU1\r", b"F": b"F00\r"}
        return answers.get(letter, ERROR)

    def _transmit(self, line: bytes) -> bytes:
        digits = 3 if line[:1] == b"t" else 8
        try:
            can_id, length = int(line[1 : 1 + digits], 16), int(line[1 + digits : 2 + digits])
            data = bytes.fromhex(line[2 + digits :].decode("ascii"))
        except ValueError:
            return ERROR
        if len(data) != length or not self._open or self._listen_only:
            return ERROR
        self._on_frame(can_id, data)
        return b"z\r" if digits == 3 else b"Z\r"


def _line(frame: Frame) -> bytes:
    layout = b"t%03X%d%s\r" if frame.can_id <= LARGEST_STANDARD_ID else b"T%08X%d%s\r"
    return layout % (frame.can_id, len(frame.data), frame.data.hex().upper().encode())
