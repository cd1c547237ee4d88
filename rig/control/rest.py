"""The rest between tests and trains, counted from the last pulse, and kept when the process ends.

The machine's monotonic clock continues across processes until the machine is rebooted, so a clean restart of the rig
shortens no rest. The wall clock is not used: a wrong time can neither shorten nor lengthen a rest. In case of doubt
(another boot, another machine, an unreadable file, a crash during a test) the last pulse is assumed to be now: a rest
may be longer than asked for, never shorter.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

from stimrig.rig import limits
from stimrig.rig.acquire.run import LEAD_S
from stimrig.rig.clock import utc_text
from stimrig.rig.control.small_file import SmallFile
from stimrig.rig.errors import RestError, RigError
from stimrig.rig.machine import Machine
from stimrig.rig.plan import PlannedTest

log = logging.getLogger("rig.rest")


class Rest:
    """Time of the last pulse on the rig's clock; None: there was none with this data folder."""

    def __init__(self, folder: Path, machine: Machine) -> None:
        self._folder, self._machine, self._clock = folder, machine, machine.tasks.clock
        self._file = SmallFile(folder / "last-pulse.json", "the last pulse's time could not be written", machine)
        self.last_pulse_s: float | None = None
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
            log.error("%s", error)
            with contextlib.suppress(RigError):  # the disk is read-only now: the latch file still says that a test ran
                await self._file.remove()

    def doubt(self) -> str:
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

        Older versions stored no time of the last pulse.
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
