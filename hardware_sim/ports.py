"""The emulator's access to the operating system: pseudo-terminals as serial ports, and waiting on several at once."""

from __future__ import annotations

import fcntl
import os
import selectors
import socket
import struct
import termios
import tty
from collections.abc import Callable
from typing import Any

INPUT_SPEED, OUTPUT_SPEED = 4, 5
"""Indices into the result of `tcgetattr`."""


class PseudoTerminal:
    """A raw pseudo-terminal that outlives its clients and never blocks.

    The emulator keeps the slave side open itself. Otherwise the master would report EIO each time the rig closes the
    port. Unread messages wait as in a device's FIFO; a message that would exceed `fifo_bytes` is dropped whole.

    A pseudo-terminal has no parity, and the C library reports a change of nothing but parity as invalid. A second
    client could therefore not open the port with even parity, as it could on hardware. `forget_speed` sets the speed
    back, so that each client changes something.
    """

    def __init__(self, fifo_bytes: int = 65536) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.dropped_messages = 0
        self.is_open = True
        self._fifo_bytes = fifo_bytes
        self._pending = bytearray()
        self._seen_speed = self._own_speed = termios.tcgetattr(self._slave)[OUTPUT_SPEED]

    def fileno(self) -> int:
        """The master's descriptor, for select."""
        return self._master

    def read(self) -> bytes:
        """Return the bytes that the client has written since the last call; empty if none."""
        self.forget_speed(settled=True)
        try:
            return os.read(self._master, 65536)
        except OSError:
            return b""

    def forget_speed(self, settled: bool = False) -> None:
        """Set back the speed that a client has set.

        Not before the second call that sees it, since the client may still be opening the port; at once if `settled`,
        since a client that writes has opened it.
        """
        if not self.is_open:
            return
        settings = termios.tcgetattr(self._slave)
        previous, self._seen_speed = self._seen_speed, settings[OUTPUT_SPEED]
        if self._seen_speed != self._own_speed and (settled or previous == self._seen_speed):
            settings[INPUT_SPEED] = settings[OUTPUT_SPEED] = self._own_speed
            termios.tcsetattr(self._slave, termios.TCSANOW, settings)

    def unread_bytes(self) -> int:
        """Count the bytes that the client has not read yet."""
        if not self.is_open:
            return 0
        (queued,) = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)))
        return queued + len(self._pending)

    def write(self, message: bytes) -> None:
        """Queue one message for the client and send what fits."""
        if not self.is_open:
            return
        if len(self._pending) + len(message) > self._fifo_bytes:
            self.dropped_messages += 1
        else:
            self._pending += message
        self.flush()

    def flush(self) -> None:
        """Send as much of the queue as fits."""
        if not (self._pending and self.is_open):
            return
        try:
            written = os.write(self._master, self._pending)
        except OSError:  # full: nobody reads
            return
        del self._pending[:written]

    def close(self) -> None:
        """Unplug: a client that has the port open reads end of file or EIO."""
        if self.is_open:
            self.is_open = False
            os.close(self._slave)
            os.close(self._master)


class Reactor(selectors.SelectSelector):
    """Calls a function for each socket or port that has something to read; its time limit is finer than epoll's."""

    def add(self, source: Any, on_readable: Callable[[], None]) -> None:
        """Call `on_readable` whenever `source` has something to read; to be unregistered before it is closed."""
        self.register(source, selectors.EVENT_READ, on_readable)

    def poll(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` for something to read, and serve all that have."""
        for key, _ in self.select(max(0.0, timeout_s)):
            if key.fd in self.get_map():  # an earlier callback may have closed it
                key.data()


class Client:
    """One connection: what was received and not yet taken, and what was not yet sent."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received, self.backlog = b"", bytearray()
        self.state: Any = None
        """Its server's own."""


class Server:
    """Any number of clients of a listening socket; nothing blocks. `on_data` is called when a client has sent some."""

    def __init__(self, reactor: Reactor, listener: socket.socket, on_data: Callable[[Client], None]) -> None:
        self.clients: list[Client] = []
        self._reactor, self._listener, self._on_data = reactor, listener, on_data
        listener.setblocking(False)
        reactor.add(listener, self._accept)

    def connected(self, client: Client) -> None:
        """A client has come."""

    def flush(self) -> None:
        """Send each client what fits of what it has not got."""
        for client in [client for client in self.clients if client.backlog]:
            try:
                del client.backlog[: client.connection.send(client.backlog)]
            except BlockingIOError:
                continue
            except OSError:
                self._drop(client)

    def close(self) -> None:
        """Close the socket and every connection."""
        for client in list(self.clients):
            self._drop(client)
        if self._listener.fileno() >= 0:
            self._reactor.unregister(self._listener)
            self._listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has already disconnected
            return
        connection.setblocking(False)
        self.clients.append(client := Client(connection))
        self._reactor.add(connection, lambda: self._read(client))
        self.connected(client)

    def _read(self, client: Client) -> None:
        try:
            data = client.connection.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.received += data
        self._on_data(client)
        self.flush()

    def _drop(self, client: Client) -> None:
        self.clients.remove(client)
        self._reactor.unregister(client.connection)
        client.connection.close()
