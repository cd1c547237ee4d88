"""A CAN adapter, opened once for all devices that hang on it.

Some adapters can be opened only once (slcan). So the first device that opens one reads it for all: frames that others
asked for go into their queues, with the time at which the first one read them.
"""

from __future__ import annotations

import contextlib
import logging
import math
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, cast

import can
import serial
from can.interfaces.slcan import slcanBus

from rig.clock import Clock
from rig.errors import DeviceError, WireError
from rig.wire.read_ahead import ReadAhead

ATTEMPTS = 5
STAMPING = ("socketcand", "socketcan", "pcan", "kvaser", "ixxat", "vector")
"""Timestamps of these interfaces are the sender's or the kernel's, of the others the host's at reading."""
MOST_WAITING = 20_000
"""Frames that wait for a device that does not read; later ones are dropped, and its counter shows the gap."""

_open: dict[tuple[str, ...], CanBus] = {}
_registering = threading.Lock()


class Frame(NamedTuple):
    """A frame, when the host read it (rig clock, s) and the interface's own stamp of it (s; NaN: none)."""

    message: can.Message
    host_time_s: float
    stamp_s: float


class Tap:
    """The frames of one identifier on an adapter that another device reads."""

    def __init__(self, name: str, frame_id: int) -> None:
        self.frame_id = frame_id
        self._name = name
        self._waiting: queue.SimpleQueue[Frame | None] = queue.SimpleQueue()

    def put(self, frame: Frame | None) -> None:
        """One more frame; None: the adapter was closed."""
        if frame is None or self._waiting.qsize() < MOST_WAITING:
            self._waiting.put(frame)

    def receive(self, timeout_s: float) -> Frame | None:
        """The next frame within real seconds, or None. Raises DeviceError once the adapter was closed."""
        try:
            frame = self._waiting.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None
        if frame is None:
            self.put(None)
            raise DeviceError(f"{self._name}: the load cell's bus, which it shares, was closed")
        return frame


class CanBus:
    """One adapter.

    Parameters
    ----------
    arguments
        Of can.Bus.
    name
        Of the device that opens it, in words; with `_` it is its table in the rig file.
    """

    def __init__(self, arguments: dict[str, Any], name: str, clock: Clock) -> None:
        self._name, self._clock = name, clock
        self._key, self.place = _key(arguments), place_of(arguments)
        self._arguments, self._taps = dict(arguments), list[Tap]()
        self._stamped = arguments.get("interface") in STAMPING
        # python-can warns about every frame that is split between two packets, which is normal
        logging.getLogger("can").setLevel(logging.CRITICAL)
        self.can = self._opened()
        with _registering:
            _open[self._key] = self

    @staticmethod
    def tap(arguments: dict[str, Any], name: str, frame_id: int) -> Tap | None:
        """The frames of an identifier if the adapter is already open; None: it is not.

        Raises DeviceError if it is open with other arguments.
        """
        with _registering:
            found = _open.get(_key(arguments))
            if found is None:
                return None
            if found._arguments != arguments:
                raise DeviceError(
                    f"{_table(name)}.bus: {found.place} is already open with other arguments; give the same as for the "
                    f"{found._name}, or leave it out"
                )
            tap = Tap(name, frame_id)
            found._taps = [*found._taps, tap]
            return tap

    @staticmethod
    def untap(tap: Tap) -> None:
        """Hand no more frames to it."""
        with _registering:
            for bus in _open.values():
                bus._taps = [other for other in bus._taps if other is not tap]

    def receive(self, timeout_s: float) -> Frame | None:
        """The next frame within real seconds, or None; one thread only.

        Raises DeviceError when the bus is gone, and WireError for a damaged frame.
        """
        try:
            message = self.can.recv(timeout_s)
        except ValueError as error:  # slcan: a damaged line
            raise WireError(_line(error)) from None
        except (can.CanError, OSError) as error:
            raise DeviceError(f"{self._name} on {self.place}: the bus was lost: {_line(error)}") from None
        except Exception as error:
            raise DeviceError(f"{self._name} on {self.place}: reading failed: {_line(error)}") from None
        if message is None:
            return None
        frame = Frame(message, self._clock.now_s(), message.timestamp if self._stamped else math.nan)
        for tap in self._taps:
            if tap.frame_id == message.arbitration_id and not (message.is_error_frame or message.is_remote_frame):
                tap.put(frame)
        return frame

    def send(self, messages: Iterable[can.Message]) -> None:
        """Send frames. Raises DeviceError."""
        for message in messages:
            try:
                self.can.send(message, timeout=0.5)
            except (can.CanError, OSError) as error:
                digits = 8 if message.is_extended_id else 3
                frame = f"{message.arbitration_id:0{digits}X}#{message.data.hex()}"
                raise DeviceError(f"{self._name} on {self.place}: frame {frame} not sent: {_line(error)}") from None

    def close(self) -> None:
        """Close it for all; never raises."""
        with _registering:
            if _open.get(self._key) is self:
                del _open[self._key]
        for tap in self._taps:
            tap.put(None)
        with contextlib.suppress(Exception):
            self.can.shutdown()

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


def gather(
    source: CanBus | Tap, frame_id: int, timeout_s: float, gather_s: float, take: Callable[[Frame], None]
) -> tuple[int, int]:
    """Hand the frames of an identifier to `take` as they arrive; how many were damaged, and how many told of an error.

    Parameters
    ----------
    timeout_s
        Real seconds to wait for the first one.
    gather_s
        Real seconds to go on after it.
    take
        Raises WireError for a frame that it cannot read.

    Raises
    ------
    DeviceError
        The bus is gone.
    """
    damaged = errors = taken = 0
    end_s = time.monotonic() + timeout_s
    while (remaining_s := end_s - time.monotonic()) > 0:
        try:
            frame = source.receive(remaining_s)
            if frame is None:
                continue
            if frame.message.is_error_frame:
                errors += 1
                continue
            if frame.message.arbitration_id != frame_id or frame.message.is_remote_frame:
                continue
            take(frame)
        except WireError:
            damaged += 1
            continue
        taken += 1
        if taken == 1:
            end_s = min(end_s, time.monotonic() + gather_s)
    return damaged, errors


def place_of(arguments: dict[str, Any]) -> str:
    """How messages call an adapter."""
    where = arguments.get("channel", "")
    if "host" in arguments:
        where = f"{where}@{arguments['host']}:{arguments.get('port')}"
    return f"{arguments.get('interface', 'default interface')} {where}".strip()


def _key(arguments: dict[str, Any]) -> tuple[str, ...]:
    """What tells one adapter from another."""
    return tuple(str(arguments.get(name, "")) for name in ("interface", "channel", "host", "port"))


def _table(name: str) -> str:
    return name.replace(" ", "_")


def _line(error: Exception | None) -> str:
    return " ".join(str(error).split())
