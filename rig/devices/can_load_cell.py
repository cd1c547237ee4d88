"""A torque cell on a CAN bus. A DBC file describes its message and signals.

The bus may be any that python-can supports: socketcan on hardware, socketcand or slcan elsewhere.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from typing import Any

from pydantic import Field, field_validator

from stimrig.rig.devices._can import CELL_FAULT, PACKAGED, CanSensor, CanSettings, FrameSamples
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Frame, Machine
from stimrig.rig.signals import SAMPLE, Block

KIND = "load_cell"

_FRAME = re.compile(r"^([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#((?:[0-9A-Fa-f]{2}){0,8})$")


class Settings(CanSettings):
    bus: dict[str, Any] = Field(description="keyword arguments of can.Bus: interface, channel, bitrate, host, port …")
    dbc: str = Field(PACKAGED, description="path of a DBC file, or torque_default")
    message: str | None = Field(None, description="message with the torque; default: the first one that has the signal")
    signal: str | list[str] = Field("Torque_Nm", description="torque signal; a list if a frame has several samples")
    scale_nm: float = Field(1.0, description="N·m per unit of the signal; a negative value reverses the sign")
    counter: str | None = Field("Counter", description="signal of the sample counter; '' if the cell has none")
    sync: str | None = Field("Sync", description="signal of the stimulator's sync line; '' if there is none")
    fault: str | None = Field(
        CELL_FAULT, description="signal of the word by which it reports a fault, 0: none; '' if there is none"
    )
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


def message_of(frame: str) -> tuple[int, bytes, bool]:
    """Identifier and data of `id#data`, and whether the identifier is extended: it has eight digits then."""
    matched = _FRAME.match(frame)
    assert matched is not None
    identifier, data = matched.groups()
    return int(identifier, 16), bytes.fromhex(data), len(identifier) == 8


class CanLoadCell(CanSensor):
    """Driver of one cell."""

    name, dtype = "load cell", SAMPLE

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings = settings
        names = [settings.signal] if isinstance(settings.signal, str) else settings.signal
        super().__init__(settings, machine, names, settings.counter, settings.sync, "sync", settings.fault)

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        work = self._machine.tasks.work
        bus = await work(self._machine.open_bus, self._settings.bus, self.name)
        identity = self._listen(bus, on_block, on_lost)
        try:
            await work(bus.send, [message_of(frame) for frame in self._settings.start_frames])
        except DeviceError:
            assert self._listener is not None
            bus.detach(self._listener)  # it is told by what is raised, not by a loss as well
            await self.close()
            raise
        return identity

    async def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        work = self._machine.tasks.work
        with contextlib.suppress(Exception):  # an unplugged adapter raises, and there is nothing left to stop
            await work(bus.send, [message_of(frame) for frame in self._settings.stop_frames])
        await work(bus.close)

    def _rows(self, frame: Frame, samples: FrameSamples) -> Iterator[tuple[float, ...]]:
        n = len(samples.values)
        for i, value in enumerate(samples.values):
            counter = samples.counter * n + i if samples.counter >= 0 else -1
            stamp_s = frame.stamp_s - (n - 1 - i) / self.sample_rate_hz  # a frame is sent with its last sample
            yield frame.host_time_s, stamp_s, value * self._settings.scale_nm, counter, samples.flag


create = CanLoadCell
