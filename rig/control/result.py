"""A calibration's result, kept from its end until a client has stored it: a lost answer loses no thresholds."""

from __future__ import annotations

import logging
from datetime import datetime
from pathlib import Path

from stimrig.rig.control.small_file import SmallFile
from stimrig.rig.errors import BusyError
from stimrig.rig.machine import Machine
from stimrig.rig.messages import Calibrated

log = logging.getLogger("rig")


class Result:
    """Written before the result is told."""

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._file, self._clock = SmallFile(folder / "calibrated.json", "calibration", machine), machine.tasks.clock
        self._kept: Calibrated | None = None

    @property
    def waiting(self) -> Calibrated | None:
        """What nobody has stored yet; None also once its day has ended: then it is no profile any more."""
        profile = self._kept and self._kept.result.profile
        if not profile or not profile.expires_at_utc:
            return None
        return self._kept if self._clock.unix_s() < datetime.fromisoformat(profile.expires_at_utc).timestamp() else None

    def of(self, calibration_id: str) -> Calibrated | None:
        """The result of that calibration, if it waits."""
        return self.waiting if self.waiting and self.waiting.calibration_id == calibration_id else None

    def refuse_waiting(self) -> None:
        """Raise BusyError if one waits: a new calibration would replace it."""
        if (kept := self.waiting) is not None:
            raise BusyError(
                f"the result of calibration {kept.calibration_id} of participant {kept.participant} waits to be "
                "stored; finish that one again, or discard it"
            )

    async def recall(self) -> None:
        """Read what the process before kept."""
        try:
            content = await self._file.read()
            self._kept = None if content is None else Calibrated.model_validate(content)
        except (OSError, ValueError) as error:
            log.error("%s: not readable (%s); calibrate again", self._file.path, " ".join(str(error).split()))

    async def keep(self, found: Calibrated) -> None:
        """Raises RigError: it could not be written, so it must not be told yet."""
        await self._file.write(found.model_dump(mode="json"))
        self._kept = found

    async def let_go(self, calibration_id: str) -> None:
        """It is stored, or discarded; nothing if another one waits. Raises RigError: it waits still."""
        if self.of(calibration_id) is not None:
            await self._file.remove()
            self._kept = None
