"""An angle sensor on a CAN bus: a frame of its own, or a signal in the load cell's frame. A DBC file describes it.

It shares the load cell's adapter where that is the same one, so each adapter is opened once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Bus, Frame, Listener, Machine
from stimrig.rig.signals import ANGLE_SAMPLE, AngleScale, Block
from stimrig.rig.wire import dbc

KIND = "angle_sensor"

NAME = "angle sensor"
GATHER_S = 0.01
"""Real seconds: a block is returned at most this long after its first sample arrived."""
OF_THE_CELL = "dbc", "message", "counter", "sample_rate_hz"
"""Settings that the load cell's replace where the angle stands in its frame, unless the rig file gives them."""


class Settings(DeviceSettings):
    bus: dict[str, Any] = Field(default_factory=dict, description="as the load cell's, and by default the same")
    dbc: str = Field("angle_default", description="path of a DBC file, or angle_default")
    message: str | None = Field(None, description="message with the angle; default: the first one that has the signal")
    signal: str = Field("Angle_deg", description="angle signal")
    counter: str | None = Field("Counter", description="signal of the counter of frames; '' if there is none")
    fault: str | None = Field(
        "Fault", description="signal of the word by which it reports a fault, 0: none; '': no word"
    )
    sample_rate_hz: float = Field(200.0, gt=0, le=20_000)
    radians_per_unit: float = Field(math.pi / 180, gt=0, description="rad per unit of the signal")
    direction: Literal[-1, 1] = Field(1, description="-1: the signal falls when the joint is flexed")
    offset: float = Field(0.0, description="signal of a straight arm, in its unit")
    of_the_cell: bool = Field(False, description="the signal stands in the load cell's own frame")

    def beside(self, _cell: DeviceSettings) -> Self:
        """The cell's bus, and of a signal in its frame the cell's description, unless the rig file gives others."""
        given, cell = self.model_fields_set, _cell.model_dump()
        taken = {} if self.bus else {"bus": cell.get("bus", {})}
        if self.of_the_cell:
            taken |= {name: cell[name] for name in OF_THE_CELL if name in cell and name not in given}
            several = cell.get("signal")
            if isinstance(several, list) and "sample_rate_hz" in taken:
                taken["sample_rate_hz"] /= len(several)
        return self.model_copy(update=taken)


class CanAngleSensor:
    """Driver of one sensor; see `stimrig.rig.devices.AngleSensor` for what the methods promise."""

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings, self._machine = settings, machine
        with dbc.of_table(KIND):
            self._frame = dbc.SampleFrame(
                settings.dbc, settings.message, [settings.signal], settings.counter, settings.fault, "fault"
            )
        self.sample_rate_hz, self.counter_modulus = settings.sample_rate_hz, self._frame.counter_modulus
        self.scale = AngleScale(settings.offset, settings.direction, settings.radians_per_unit)
        self.of_the_cell = settings.of_the_cell
        self.on_the_cells_bus = False
        self._bus: Bus | None = None
        self._listener: Listener | None = None

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        arguments, frame_id = self._settings.bus, self._frame.frame_id
        bus = self._machine.shared_bus(arguments, NAME)
        self.on_the_cells_bus = bus is not None
        if bus is None:
            if self.of_the_cell:
                raise DeviceError(f"{KIND}.of_the_cell: the load cell's bus is not open")
            bus = await self._machine.tasks.work(self._machine.open_bus, arguments, NAME)
        self._bus, self._listener = bus, Listener(*self._frame.identifier, self.decode, on_block, on_lost, GATHER_S)
        bus.listen(self._listener)
        return {
            "device": "can_angle_sensor",
            "bus": bus.place,
            "frame_id": f"0x{frame_id:X}",
            "message": self._frame.message.name,
            "sample_rate_hz": self.sample_rate_hz,
        }

    async def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self.on_the_cells_bus and self._listener is not None:
            bus.leave(self._listener)
        else:
            await self._machine.tasks.work(bus.close)

    def decode(self, frames: Sequence[Frame], damaged: int = 0, errors: int = 0) -> Block:
        """The samples of frames, in their order; damaged ones are counted. Pure."""
        rows: list[tuple[float, float, float, float, int, int]] = []
        readable, unreadable = self._frame.decode_all(frames)
        for frame, found in readable:
            rows.append((frame.host_time_s, frame.stamp_s, found.values[0], math.nan, found.counter, found.flag))
        samples = np.array(rows, dtype=ANGLE_SAMPLE)
        samples["angle_rad"] = self.scale.angle_rad(samples["raw"])
        return Block(samples, damaged + unreadable, errors)


create = CanAngleSensor
