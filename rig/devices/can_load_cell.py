"""A torque cell on a CAN bus. A DBC file describes its message and signals.

The bus may be any that python-can supports: socketcan on hardware, socketcand or slcan elsewhere.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import socket
import time
from typing import Any, cast

import can
import numpy as np
import serial
from can.interfaces.slcan import slcanBus
from pydantic import Field, field_validator

from rig.clock import Clock
from rig.devices import DeviceSettings
from rig.errors import ConfigError, DeviceError, WireError
from rig.signals import SAMPLE, TorqueBlock
from rig.wire import dbc
from rig.wire.read_ahead import ReadAhead

KIND = "load_cell"

GATHER_S = 0.005
"""Real seconds: a block is returned at most this long after its first sample arrived."""

_FRAME = re.compile(r"^([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#((?:[0-9A-Fa-f]{2}){0,8})$")


class Settings(DeviceSettings):
    bus: dict[str, Any] = Field(description="keyword arguments of can.Bus: interface, channel, bitrate, host, port …")
    dbc: str = Field(dbc.PACKAGED, description="path of a DBC file, or torque_default")
    message: str | None = Field(None, description="message with the torque; default: the first one that has the signal")
    signal: str | list[str] = Field("Torque_Nm", description="torque signal; a list if a frame has several samples")
    scale_nm: float = Field(1.0, description="N·m per unit of the signal; a negative value reverses the sign")
    counter: str | None = Field("Counter", description="signal of the sample counter; '' if the cell has none")
    sync: str | None = Field("Sync", description="signal of the stimulator's sync line; '' if there is none")
    sample_rate_hz: float = Field(1600.0, gt=0, le=20_000)
    start_frames: list[str] = Field(default_factory=list, description="sent on opening, as id#data in hex: 000#0100")
    stop_frames: list[str] = Field(default_factory=list, description="sent on closing")

    @field_validator("start_frames", "stop_frames")
    @classmethod
    def _hex_frames(cls, frames: list[str]) -> list[str]:
        for frame in frames:
            if not _FRAME.match(frame):
                raise ValueError(f"{frame!r} is not a frame; write id#data in hex, e.g. 000#0100")
        return frames

    @field_validator("scale_nm")
    @classmethod
    def _not_zero(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("a scale of 0 would hide every torque; give N·m per unit of the signal")
        return scale


def message_of(frame: str) -> can.Message:
    """A CAN message from `id#data`; eight digits of id make it extended."""
    matched = _FRAME.match(frame)
    assert matched is not None
    identifier, data = matched.groups()
    return can.Message(
        arbitration_id=int(identifier, 16), data=bytes.fromhex(data), is_extended_id=len(identifier) == 8
    )


class CanLoadCell:
    """Driver of one cell; see `rig.devices.LoadCell` for what the methods promise."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        names = [settings.signal] if isinstance(settings.signal, str) else settings.signal
        try:
            self._frame = dbc.TorqueFrame(
                settings.dbc, settings.message, names, settings.counter or None, settings.sync or None
            )
        except ConfigError as error:
            raise ConfigError(f"load_cell.{error}") from None
        self.sample_rate_hz = settings.sample_rate_hz
        self.counter_modulus = self._frame.counter_modulus * self._frame.samples_per_frame
        self._bus: can.BusABC | None = None
        self._stamped = False
        # python-can warns about every frame that is split between two packets, which is normal
        logging.getLogger("can").setLevel(logging.CRITICAL)

    def open(self) -> dict[str, Any]:
        bus = self._bus_arguments()
        self._probe(bus)
        last: Exception | None = None
        for _ in range(5):
            try:
                self._bus = can.Bus(**bus)
                break
            except can.CanError as error:
                # the server's greeting and the first frame may share a packet, which aborts the handshake
                last = error
                time.sleep(0.05)
            except Exception as error:
                raise DeviceError(f"load_cell.bus: {self._place()} cannot be opened: {_line(error)}") from None
        if self._bus is None:
            raise DeviceError(f"load_cell.bus: {self._place()} cannot be opened: {_line(last)}")
        if isinstance(self._bus, slcanBus) and isinstance(self._bus.serialPortOrig, serial.Serial):
            self._bus.serialPortOrig = cast("Any", ReadAhead(self._bus.serialPortOrig))
        # Timestamps of these interfaces are the sender's or the kernel's, of the others the host's at reading.
        self._stamped = bus.get("interface") in ("socketcand", "socketcan", "pcan", "kvaser", "ixxat", "vector")
        self._send(self._settings.start_frames)
        return {
            "device": "can_load_cell",
            "bus": self._place(),
            "frame_id": f"0x{self._frame.frame_id:X}",
            "message": self._frame.message.name,
            "sample_rate_hz": self.sample_rate_hz,
        }

    def read(self, timeout_s: float) -> TorqueBlock:
        if self._bus is None:
            raise DeviceError("load cell is not open")
        rows: list[tuple[float, float, float, int, int]] = []
        malformed = error_frames = 0
        end_s = time.monotonic() + timeout_s
        while (remaining_s := end_s - time.monotonic()) > 0:
            try:
                message = self._bus.recv(remaining_s)
            except ValueError:
                malformed += 1  # slcan: a damaged line
                continue
            except (can.CanError, OSError) as error:
                raise DeviceError(f"load cell on {self._place()}: the bus was lost: {_line(error)}") from None
            except Exception as error:
                raise DeviceError(f"load cell on {self._place()}: reading failed: {_line(error)}") from None
            if message is None:
                continue
            if message.is_error_frame:
                error_frames += 1
                continue
            if message.arbitration_id != self._frame.frame_id or message.is_remote_frame:
                continue
            try:
                self._append(rows, message)
            except WireError:
                malformed += 1
                continue
            if len(rows) == self._frame.samples_per_frame:
                end_s = min(end_s, time.monotonic() + GATHER_S)
        return TorqueBlock(np.array(rows, dtype=SAMPLE), malformed, error_frames)

    def close(self) -> None:
        if self._bus is None:
            return
        with contextlib.suppress(Exception):  # an unplugged adapter raises, and there is nothing left to stop
            self._send(self._settings.stop_frames)
        with contextlib.suppress(Exception):
            self._bus.shutdown()
        self._bus = None

    def _append(self, rows: list[tuple[float, float, float, int, int]], message: can.Message) -> None:
        host_time_s = self._clock.now_s()
        last_s = message.timestamp if self._stamped else math.nan
        frame = self._frame.decode(bytes(message.data))
        n = len(frame.values)
        for i, value in enumerate(frame.values):
            counter = frame.counter * n + i if frame.counter >= 0 else -1
            stamp_s = last_s - (n - 1 - i) / self.sample_rate_hz  # a frame is sent with its last sample
            rows.append((host_time_s, stamp_s, value * self._settings.scale_nm, counter, frame.sync))

    def _bus_arguments(self) -> dict[str, Any]:
        bus = dict(self._settings.bus)
        if bus.get("interface") == "slcan":
            bus.setdefault("sleep_after_open", 0)
        return bus

    def _probe(self, bus: dict[str, Any]) -> None:
        """Fail early if no server answers: python-can itself would retry for ten seconds."""
        if bus.get("interface") != "socketcand":
            return
        host, port = bus.get("host"), bus.get("port")
        try:
            socket.create_connection((str(host), int(str(port))), timeout=2.0).close()
        except (OSError, ValueError) as error:
            raise DeviceError(
                f"load_cell.bus: no socketcand answers at {host}:{port} ({_line(error)}); check that it is running"
            ) from None

    def _send(self, frames: list[str]) -> None:
        assert self._bus is not None
        for frame in frames:
            try:
                self._bus.send(message_of(frame), timeout=0.5)
            except (can.CanError, OSError) as error:
                raise DeviceError(f"load cell on {self._place()}: frame {frame} not sent: {_line(error)}") from None

    def _place(self) -> str:
        bus = self._settings.bus
        where = bus.get("channel", "")
        if "host" in bus:
            where = f"{where}@{bus['host']}:{bus.get('port')}"
        return f"{bus.get('interface', 'default interface')} {where}".strip()


def _line(error: Exception | None) -> str:
    return " ".join(str(error).split())


def create(settings: Settings, clock: Clock) -> CanLoadCell:
    """The device, not yet opened.

    Raises
    ------
    ConfigError
        The DBC lacks the message or signal.
    """
    return CanLoadCell(settings, clock)
