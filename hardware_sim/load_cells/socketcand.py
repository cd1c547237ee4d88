"""A socketcand server on 127.0.0.1 with one bus, `can0`, in raw mode.

Frames begin `QUIET_S` after the answer to `< rawmode >`. A client that reads the answer and the first frame in one
packet takes the handshake as failed, and nothing on the wire shows when it has read the answer.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Sequence
from typing import Any

from stimrig.hardware_sim.load_cells.frames import LARGEST_STANDARD_ID, Frame, FrameHandler
from stimrig.hardware_sim.ports import Client, Reactor, Server

CHANNEL = "can0"
QUIET_S = 0.05
LARGEST_BACKLOG_BYTES = 1 << 20
UNOPENED, OPENED = math.inf, math.nan
"""States of a client before it is in raw mode; then its state is the time from which frames are sent to it."""


class Socketcand(Server):
    """Serves any number of clients, each with the same frames."""

    def __init__(self, reactor: Reactor, on_frame: FrameHandler) -> None:
        listener = socket.create_server(("127.0.0.1", 0))
        super().__init__(reactor, listener, self._obey)
        self._on_frame = on_frame
        host, port = listener.getsockname()
        self.can: dict[str, Any] = {"interface": "socketcand", "host": host, "port": port, "channel": CHANNEL}

    def connected(self, client: Client) -> None:
        """Greet it."""
        client.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.state = UNOPENED
        client.backlog += b"< hi >"
        self.flush()

    def send(self, frames: Sequence[Frame]) -> None:
        """Frames to every client in raw mode."""
        message = b"".join(map(_text, frames)) if self.clients else b""
        now_s = time.monotonic()
        for client in self.clients:
            if (
                client.state <= now_s and len(client.backlog) < LARGEST_BACKLOG_BYTES
            ):  # one that does not read loses them
                client.backlog += message
        self.flush()

    def _obey(self, client: Client) -> None:
        *messages, rest = client.received.split(b">")
        client.received = rest[-4096:]
        for message in messages:
            words = message.decode("ascii", errors="replace").replace("<", " ").split()
            client.backlog += self._answer(client, words)

    def _answer(self, client: Client, words: list[str]) -> bytes:
        opened = client.state != UNOPENED
        match words:
            case ["open", name]:
                client.state = OPENED if name == CHANNEL else UNOPENED
                return b"< ok >" if name == CHANNEL else b"< error could not open bus >"
            case ["rawmode"] if opened:
                client.state = time.monotonic() + QUIET_S
                return b"< ok >"
            case ["send", can_id, length, *data] if opened:
                try:
                    payload = bytes(int(byte, 16) for byte in data)
                    if len(payload) == int(length, 16):
                        self._on_frame(int(can_id, 16), payload)
                        return b""
                except ValueError:
                    pass
        return b"< error unknown command >"


def _text(frame: Frame) -> bytes:
    seconds, micros = divmod(frame.time_us, 1_000_000)
    if frame.error:
        return b"< error %08X %d.%06d >" % (frame.can_id, seconds, micros)
    layout = b"< frame %03X %d.%06d %s >" if frame.can_id <= LARGEST_STANDARD_ID else b"< frame %08X %d.%06d %s >"
    return layout % (frame.can_id, seconds, micros, frame.data.hex().upper().encode())
