"""An angle sensor on a CAN bus: a frame of its own, or a signal in the load cell's frame. A DBC file describes it.

It shares the load cell's adapter where that is the same one, so each adapter is opened once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Literal, Self

from pydantic import Field

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.devices._can import CanSensor, CanSettings, FrameSamples
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Frame, Machine
from stimrig.rig.signals import ANGLE_SAMPLE, AngleScale, Block

KIND = "angle_sensor"
OF_THE_CELL = "dbc", "message", "counter", "sample_rate_hz"
"""Settings that the load cell's replace where the angle stands in its frame, unless the rig file gives them."""


class Settings(CanSettings):
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

    def with_cell(self, _cell: DeviceSettings) -> Self:
        """The cell's bus, and of a signal in its frame the cell's description, unless the rig file gives others."""
        set_fields, cell = self.model_fields_set, _cell.model_dump()
        shared = {} if self.bus else {"bus": cell.get("bus", {})}
        if self.of_the_cell:
            shared |= {name: cell[name] for name in OF_THE_CELL if name in cell and name not in set_fields}
            several = cell.get("signal")
            if isinstance(several, list) and "sample_rate_hz" in shared:
                shared["sample_rate_hz"] /= len(several)
        return self.model_copy(update=shared)


class CanAngleSensor(CanSensor):
    """Driver of one sensor; see `rig.devices.AngleSensor` for what the methods promise."""

    name, dtype = "angle sensor", ANGLE_SAMPLE

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings = settings
        super().__init__(settings, machine, [settings.signal], settings.counter, settings.fault, "fault")
        self.scale = AngleScale(settings.offset, settings.direction, settings.radians_per_unit)
        self.of_the_cell = settings.of_the_cell
        self.on_the_cells_bus = False

    async def open(self, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        bus = self._machine.shared_bus(self._settings.bus, self.name)
        self.on_the_cells_bus = bus is not None
        if bus is None:
            if self.of_the_cell:
                raise DeviceError(f"{KIND}.of_the_cell: the load cell's bus is not open")
            bus = await self._machine.tasks.work(self._machine.open_bus, self._settings.bus, self.name)
        return self._listen(bus, on_block, on_lost)

    async def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is None:
            return
        if self.on_the_cells_bus and self._listener is not None:
            bus.detach(self._listener)
        else:
            await self._machine.tasks.work(bus.close)

    def _rows(self, frame: Frame, samples: FrameSamples) -> Iterator[tuple[float, ...]]:
        raw = samples.values[0]
        yield frame.host_time_s, frame.stamp_s, raw, self.scale.angle_rad(raw), samples.counter, samples.flag


create = CanAngleSensor
