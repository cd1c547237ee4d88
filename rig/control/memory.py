"""Memory of the rig beyond its process: its latch, its last pulse, and a calibration's result.

Each is a small file of JSON in the data folder, synced to the disk before what it describes is told.
"""

from __future__ import annotations

import contextlib
import json
import logging
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from stimrig.rig import limits
from stimrig.rig.acquire.run import LEAD_S
from stimrig.rig.clock import utc_text
from stimrig.rig.errors import BusyError, RestError, RigError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import Calibrated
from stimrig.rig.plan import PlannedTest
from stimrig.rig.tasks import Turn

log = logging.getLogger("rig")
rest_log = logging.getLogger("rig.rest")


class SmallFile:
    """Writes in the order of requests. `place` begins the words of an error."""

    def __init__(self, path: Path, place: str, machine: Machine) -> None:
        self.path, self._place = path, place
        self._disk, self._work, self._turn = machine.disk, machine.tasks.work, Turn(machine.tasks)
        self._stored: bytes | None = None

    async def read(self) -> dict[str, Any] | None:
        """Its content; None: there is no file. Raises OSError, ValueError: it cannot be read."""
        try:
            content = json.loads(await self._work(self._disk.read, self.path))
        except FileNotFoundError:
            return None
        except RecursionError as error:
            raise ValueError(str(error)) from None
        if not isinstance(content, dict):
            raise ValueError("it is no JSON object")
        return content

    async def write(self, content: dict[str, Any]) -> None:
        """Replace the file, unless it holds that already. Raises RigError."""
        await self._write(json.dumps(content).encode())

    async def remove(self) -> None:
        """Also where there is none. Raises RigError."""
        await self._write(None)

    async def _write(self, data: bytes | None) -> None:
        async with self._turn:
            if data is not None and data == self._stored:
                return
            self._stored = None
            try:
                if data is None:
                    await self._work(self._disk.remove, self.path)
                else:
                    await self._work(self._disk.replace, self.path, data)
            except OSError as error:
                raise RigError(f"{self._place}: {self.path}: {error.strerror}; free some disk space") from None
            self._stored = data


Remembered = Literal["running", "latched"]


class LatchFile:
    """That a test was running, or that the rig is latched and why; stored before the event that it describes."""

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._file = SmallFile(folder / "latch.json", "latch file", machine)
        self.clear = self._file.remove
        """Remove the state: a person has re-armed, or a test has ended well. Raises RigError."""

    async def read(self) -> tuple[Remembered | None, str]:
        """The stored state and its reason; an unreadable file counts as a running test."""
        try:
            content = await self._file.read()
            if content is None:
                return None, ""
            return ("latched" if content["state"] == "latched" else "running"), str(content["reason"])
        except (OSError, ValueError, KeyError):
            return "running", "the latch file could not be read"

    async def write(self, state: Remembered, reason: str) -> None:
        """Store a state. Raises RigError if the disk fails: then nothing may start."""
        await self._file.write({"state": state, "reason": reason})


class Rest:
    """The rest between tests and trains, counted from the last pulse, and kept when the process ends.

    The machine's monotonic clock continues across processes until the machine is rebooted, so a clean restart of the
    rig shortens no rest. The wall clock is not used: a wrong time can neither shorten nor lengthen a rest. In case of
    doubt (another boot, another machine, an unreadable file, a crash during a test) the last pulse is assumed to be
    now: a rest may be longer than asked for, never shorter.
    """

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._folder, self._machine, self._clock = folder, machine, machine.tasks.clock
        self._file = SmallFile(folder / "last-pulse.json", "the last pulse's time could not be written", machine)
        self.last_pulse_s: float | None = None
        """On the rig's clock; None: there was none with this data folder."""
        self._ended = True

    async def recall(self, in_doubt: bool) -> None:
        """Read what the last process stored. `in_doubt`: it crashed, so the time of its last pulse is unknown."""
        remembered_s, used = await self._read()
        if remembered_s is not None and not in_doubt:
            self.last_pulse_s = remembered_s
        elif in_doubt or used:
            await self.pulse_at(self._clock.now_s(), ended=False)

    async def pulse_at(self, time_s: float, ended: bool = True) -> None:
        """Store the time of the last pulse; if the disk fails, the next process is in doubt.

        `ended` is False if the end of stimulation is not confirmed: a stalled line may still hold a pulse.
        """
        self.last_pulse_s, self._ended = time_s, ended
        content = {
            "ended": ended,
            "boot_id": self._machine.boot_id,
            "monotonic_s": time_s / self._clock.speed,
            "written_utc": utc_text(self._clock.unix_s()),
        }
        try:
            await self._file.write(content)
        except RigError as error:
            rest_log.error("%s", error)
            with contextlib.suppress(RigError):  # the disk is read-only now: the latch file still says that a test ran
                await self._file.remove()

    def uncertainty(self) -> str:
        """A sentence if the line may still hold a pulse that was sent before; empty if not."""
        return "" if self._ended else "a pulse that was sent before may still be felt"

    async def settle(self) -> None:
        """The stimulator has answered, so the line is empty; a held pulse may have been felt just now."""
        if not self._ended:
            await self.pulse_at(self._clock.now_s())

    def check(self, test: PlannedTest, limit: limits.Limit) -> None:
        """Raise RestError if the earliest pulse follows the last one too soon."""
        first = test.first_pulse
        if self.last_pulse_s is None or first is None:
            return
        first_s = first / test.plan.pulse_rate_hz + LEAD_S * self._clock.speed
        rest_s = self._clock.now_s() + first_s - self.last_pulse_s
        refusal = limits.check(limit, rest_s)
        if refusal is not None:
            raise RestError(f"plan: {refusal}; wait {limit.lo - rest_s:.1f} s")

    async def _read(self) -> tuple[float | None, bool]:
        """The stored time, if it certainly belongs to this boot; whether any test was ever played with this folder.

        A folder that was restored from a backup has recordings, but no time of the last pulse.
        """
        work, names, boot_id = self._machine.tasks.work, self._machine.disk.names, self._machine.boot_id
        try:
            content = await self._file.read()
            if content is None:
                return None, any([await work(names, self._folder / name) for name in ("recordings", "journals")])
            time_s = float(content["monotonic_s"]) * self._clock.speed
            certain = bool(boot_id) and content["boot_id"] == boot_id and content["ended"] is True
        except (OSError, ValueError, KeyError, TypeError):
            return None, True
        return (time_s if certain and 0 <= time_s <= self._clock.now_s() else None), True


class Result:
    """A calibration's result, kept from its end until a client has stored it: a lost answer loses no thresholds.

    It is written before it is told.
    """

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._file, self._clock = SmallFile(folder / "calibrated.json", "calibration", machine), machine.tasks.clock
        self._stored: Calibrated | None = None

    @property
    def waiting(self) -> Calibrated | None:
        """Result that is not yet stored by the service; None also after its day, when it is no profile any more."""
        profile = self._stored and self._stored.result.profile
        if not profile or not profile.expires_at_utc:
            return None
        return (
            self._stored if self._clock.unix_s() < datetime.fromisoformat(profile.expires_at_utc).timestamp() else None
        )

    def of(self, calibration_id: str) -> Calibrated | None:
        """The result of that calibration, if it waits."""
        return self.waiting if self.waiting and self.waiting.calibration_id == calibration_id else None

    def refuse_waiting(self) -> None:
        """Raise BusyError if one waits: a new calibration would replace it."""
        if (waiting := self.waiting) is not None:
            raise BusyError(
                f"the result of calibration {waiting.calibration_id} of participant {waiting.participant} waits to be "
                "stored; finish that one again, or discard it"
            )

    async def recall(self) -> None:
        try:
            content = await self._file.read()
            self._stored = None if content is None else Calibrated.model_validate(content)
        except (OSError, ValueError) as error:
            log.error("%s: not readable (%s); calibrate again", self._file.path, " ".join(str(error).split()))

    async def store(self, result: Calibrated) -> None:
        """Raises RigError: it could not be written, so it must not be told yet."""
        await self._file.write(result.model_dump(mode="json"))
        self._stored = result

    async def let_go(self, calibration_id: str) -> None:
        """It is stored, or discarded; nothing if another one waits. Raises RigError: it waits still."""
        if self.of(calibration_id) is not None:
            await self._file.remove()
            self._stored = None
