"""The rest between tests and trains, counted from the last pulse, and kept when the process ends.

The machine's monotonic clock continues across processes until the machine is rebooted, so a clean restart of the rig
shortens no rest. The wall clock is not used: a wrong time can neither shorten nor lengthen a rest. In case of doubt
(another boot, another machine, an unreadable file, a crash during a test) the last pulse is assumed to be now: a rest
may be longer than asked for, never shorter.
"""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path

from rig import archive, limits
from rig.acquire.run import LEAD_S
from rig.clock import Clock, utc_text
from rig.errors import RecordingError, RestError
from rig.plan import PlannedTest

log = logging.getLogger("rig.rest")

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Rest:
    """Time of the last pulse on the rig's clock; None: there was none with this data folder."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._folder, self._clock = folder, clock
        self._path = folder / "last-pulse.json"
        self.last_pulse_s: float | None = None
        self._ended = True

    def recall(self, in_doubt: bool) -> None:
        """Read what the last process stored. `in_doubt`: it crashed, so the time of its last pulse is unknown."""
        remembered_s = None if in_doubt else self._read()
        if remembered_s is not None:
            self.last_pulse_s = remembered_s
        elif in_doubt or self._path.exists() or self._used():
            self.pulse_at(self._clock.now_s(), ended=False)

    def pulse_at(self, time_s: float, ended: bool = True) -> None:
        """Store the time of the last pulse; if the disk fails, the next process is in doubt.

        `ended` is False if the end of stimulation is not confirmed: a stalled line may still hold a pulse.
        """
        self.last_pulse_s, self._ended = time_s, ended
        content = {
            "ended": ended,
            "boot_id": boot_id(),
            "monotonic_s": time_s / self._clock.speed,
            "written_utc": utc_text(self._clock.unix_s()),
        }
        try:
            archive.write_atomically(self._path, json.dumps(content).encode())
        except RecordingError as error:
            log.error("the last pulse's time could not be written: %s", error)
            with contextlib.suppress(OSError):  # the disk is read-only now: the latch file still says that a test ran
                self._path.unlink(missing_ok=True)

    def settle(self) -> None:
        """The stimulator has answered, so the line is empty; a held pulse may have been felt just now."""
        if not self._ended:
            self.pulse_at(self._clock.now_s())

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

    def _read(self) -> float | None:
        """The stored time, if it certainly belongs to this boot."""
        try:
            content = json.loads(self._path.read_text("utf-8"))
            here, monotonic_s = boot_id(), float(content["monotonic_s"])
            certain = bool(here) and content["boot_id"] == here and content["ended"] is True
        except (OSError, ValueError, KeyError, TypeError):
            return None
        time_s = monotonic_s * self._clock.speed
        return time_s if certain and 0 <= time_s <= self._clock.now_s() else None

    def _used(self) -> bool:
        """Whether any test was ever played with this folder; older versions stored no time of the last pulse."""
        return any(any((self._folder / name).glob("*")) for name in ("recordings", "journals"))


def boot_id() -> str:
    """Id of this boot of the machine; empty if the system has none."""
    try:
        return BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        return ""
