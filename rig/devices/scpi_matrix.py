"""A relay matrix that takes SCPI-99 over a serial line: lines of text that end with a newline.

`ROUT:OPEN:ALL` opens all relays, `ROUT:CLOS (@1,5)` closes those two, `ROUT:CLOS? (@1,5)` answers `1,1`, `*OPC?`
answers once they have settled, and `SYST:ERR?` what was wrong. An element has the number of its relay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import Field

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.errors import DeviceError
from stimrig.rig.machine import Machine
from stimrig.rig.tasks import Signal

KIND = "switch"
NO_ERROR = "0"
LONGEST_LINE = 4096


class Settings(DeviceSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-matrix-if00")
    channel: str = Field(description="name of the stimulator's channel that it feeds to the elements")
    elements: int = Field(ge=1, le=128, strict=True, description="how many elements, numbered from 1")
    rows: int | None = Field(None, ge=1, le=128, strict=True, description="of elements, which are numbered along them")
    columns: int | None = Field(None, ge=1, le=128, strict=True, description="elements of a row")
    pitch_mm: float | None = Field(None, gt=0, le=100, description="from the middle of one element to the next, mm")
    baudrate: int = Field(9600, ge=300, le=921_600, strict=True)
    reply_timeout_s: float = Field(0.5, gt=0, le=5, description="for each command, real seconds")


class ScpiMatrix:
    """See `stimrig.rig.devices.Switch`. One command at a time; who asks waits for its answer."""

    def __init__(self, settings: Settings, machine: Machine) -> None:
        self._settings, self._tasks = settings, machine.tasks
        self._port = machine.port(settings.port, device="switch", baudrate=settings.baudrate)
        self._read, self._answers, self._came = b"", list[str](), Signal()
        self._lost = "not opened"
        self._on_lost: Callable[[str], None] = lambda _: None

    async def open(self, on_lost: Callable[[str], None]) -> dict[str, Any]:
        settings, self._on_lost, self._read = self._settings, on_lost, b""
        await self._tasks.work(self._port.open, self._take, self._lose)
        self._lost = ""
        try:
            maker, model, serial, firmware = (*(await self._ask("*IDN?")).split(","), "", "", "", "")[:4]
        except DeviceError:
            self.close()
            raise
        said = {"device": settings.device, "id": serial.strip(), "firmware": firmware.strip(), "port": settings.port}
        laid = settings.model_dump(include={"channel", "elements", "rows", "columns", "pitch_mm"}, exclude_none=True)
        return {**said, "model": f"{maker} {model}".strip(), **laid}

    async def connect(self, elements: Sequence[int]) -> None:
        await self.open_all()  # break before make
        chosen = f"(@{','.join(map(str, elements))})"
        await self._tell(f"ROUT:CLOS {chosen}")
        every = await self._closed()
        if [number for number, closed in enumerate(every, start=1) if closed] != sorted(elements):
            raise self._error(f"asked to connect {chosen}, it says {every}")

    async def open_all(self) -> None:
        await self._tell("ROUT:OPEN:ALL")
        if any(every := await self._closed()):
            raise self._error(f"asked to open all relays, it says {every}")

    def close(self) -> None:
        self._lost = "not opened"
        self._port.close()

    async def _closed(self) -> list[bool]:
        """Whether each relay is closed, as the device says."""
        count = self._settings.elements
        said = await self._ask(f"ROUT:CLOS? (@{','.join(map(str, range(1, count + 1)))})")
        states = [state.strip() for state in said.split(",")]
        if len(states) != count or not set(states) <= {"0", "1"}:
            raise self._error(f"not the state of {count} relays: {said!r}")
        return [state == "1" for state in states]

    async def _tell(self, command: str) -> None:
        """Have a command obeyed, and wait until the relays have settled."""
        self._write(command)
        if (settled := await self._ask("*OPC?")).strip() != "1":
            raise self._error(f"{command}: it says {settled!r}")
        error = await self._ask("SYST:ERR?")
        if error.split(",")[0].strip().lstrip("+") != NO_ERROR:
            raise self._error(f"{command}: {error}")

    async def _ask(self, query: str) -> str:
        self._answers.clear()
        self._came.clear()
        self._write(query)
        if not await self._tasks.sleep(self._settings.reply_timeout_s, self._came) or not self._answers:
            raise self._error(f"{query}: {self._lost or 'no answer'}; check its power")
        return self._answers.pop(0)

    def _write(self, line: str) -> None:
        data = f"{line}\n".encode()
        try:
            if self._lost or self._port.write(data) != len(data):
                raise self._error(f"{line}: not written: {self._lost or 'the line is full'}")
        except OSError as error:
            raise self._error(f"{line}: not written: {error}") from None

    def _take(self, data: bytes, _time_s: float) -> None:
        *lines, self._read = (self._read + data)[-LONGEST_LINE:].split(b"\n")
        if lines:
            self._answers += [line.decode("ascii", "replace").strip() for line in lines]
            self._came.set()

    def _lose(self, reason: str) -> None:
        if not self._lost:
            self._lost = reason
            self._came.set()
            self._on_lost(str(self._error(reason)))

    def _error(self, words: str) -> DeviceError:
        return DeviceError(f"switch {self._settings.port}: {words}")


create = ScpiMatrix
