"""A socketcand server on 127.0.0.1 with one bus, `can0`, in raw mode.

Frames begin `QUIET_S` after the answer to `< rawmode >`. A client that reads the answer and the first frame in one
packet takes the handshake as failed, and nothing on the wire shows when it has read the answer.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from typing import Any

from stimrig.hardware_sim.load_cells.frames import LARGEST_STANDARD_ID, Frame, FrameHandler
from stimrig.hardware_sim.ports import Reactor

CHANNEL = "can0"
QUIET_S = 0.05
LARGEST_BACKLOG_BYTES = 1 << 20


class Socketcand:
    """Serves any number of clients, each with the same frames."""

    def __init__(self, reactor: Reactor, on_frame: FrameHandler) -> None:
        self._reactor, self._on_frame = reactor, on_frame
        self._clients: list[_Client] = []
        self.overruns = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        reactor.add(self._listener, self._accept)
        host, port = self._listener.getsockname()
        self.can: dict[str, Any] = {"interface": "socketcand", "host": host, "port": port, "channel": CHANNEL}

    def send(self, frames: Sequence[Frame]) -> None:
        """Frames to every client in raw mode."""
        message = b"".join(map(_text, frames)) if self._clients else b""
        now_s = time.monotonic()
        for client in list(self._clients):
            if not client.listens(now_s):
                continue
            if len(client.backlog) > LARGEST_BACKLOG_BYTES:
                self.overruns += len(frames)
            else:
                client.backlog += message
            self._flush(client)

    def close(self) -> None:
        """Close the bus for everybody."""
        for client in list(self._clients):
            self._drop(client)
        if self._listener.fileno() >= 0:
            self._reactor.remove(self._listener)
            self._listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has already disconnected
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection)
        self._clients.append(client)
        self._reactor.add(connection, lambda: self._read(client))
        self._answer(client, b"< hi >")

    def _read(self, client: _Client) -> None:
        try:
            data = client.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.text += data.decode("ascii", errors="replace")
        while client in self._clients and ">" in client.text:
            message, client.text = client.text.split(">", 1)
            self._obey(client, message.replace("<", " ").split())
        client.text = client.text[-4096:]

    def _obey(self, client: _Client, words: list[str]) -> None:
        match words:
            case ["open", name]:
                client.opened = name == CHANNEL
                self._answer(client, b"< ok >" if client.opened else b"< error could not open bus >")
            case ["rawmode"] if client.opened:
                self._answer(client, b"< ok >")
                client.raw_from_s = time.monotonic() + QUIET_S
            case ["send", can_id, length, *data] if client.opened:
                self._receive_frame(client, can_id, length, data)
            case ["echo"]:
                self._answer(client, b"< echo >")
            case _:
                self._answer(client, b"< error unknown command >")

    def _receive_frame(self, client: _Client, can_id: str, length: str, data: list[str]) -> None:
        try:
            payload = bytes(int(byte, 16) for byte in data)
            if len(payload) != int(length, 16):
                raise ValueError
            self._on_frame(int(can_id, 16), payload)
        except ValueError:
            self._answer(client, b"< error unknown command >")

    def _answer(self, client: _Client, message: bytes) -> None:
        client.backlog += message
        self._flush(client)

    def _flush(self, client: _Client) -> None:
        try:
            sent = client.connection.send(client.backlog)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        del client.backlog[:sent]

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._reactor.remove(client.connection)
            client.connection.close()


class _Client:
    """One connection: text received and not yet parsed, bytes not yet sent."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.text = ""
        self.backlog = bytearray()
        self.opened = False
        self.raw_from_s: float | None = None

    def listens(self, now_s: float) -> bool:
        """Return whether frames may be sent to it."""
        return self.raw_from_s is not None and now_s >= self.raw_from_s


def _text(frame: Frame) -> bytes:
    seconds, micros = divmod(frame.time_us, 1_000_000)
    if frame.error:
        return b"< error %08X %d.%06d >" % (frame.can_id, seconds, micros)
    layout = b"< frame %03X %d.%06d %s >" if frame.can_id <= LARGEST_STANDARD_ID else b"< frame %08X %d.%06d %s >"
    return layout % (frame.can_id, seconds, micros, frame.data.hex().upper().encode())
