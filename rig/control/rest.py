"""The rest between tests and trains, counted from the last pulse, and remembered when the process ends.

The machine's monotonic clock goes on from process to process until the machine starts anew, so a clean restart of the
rig shortens no rest. The wall clock decides nothing here: set wrong, it can neither shorten a rest nor lengthen it.
Whatever is in doubt (another boot, another machine, a file that cannot be read, a death in a test) counts as a pulse
at this moment: a rest may come out longer than asked for, never shorter.
"""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path

from rig import archive, limits
from rig.acquire.run import LEAD_S
from rig.clock import Clock, utc_text
from rig.errors import RecordingError, RefusedError
from rig.plan import PlannedTest

log = logging.getLogger("rig.rest")

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Rest:
    """When the last pulse was, on the rig's clock; None: never in this data folder."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._folder, self._clock = folder, clock
        self._path = folder / "last-pulse.json"
        self.last_pulse_s: float | None = None
        self._ended = True

    def recall(self, in_doubt: bool) -> None:
        """What the process before has left. `in_doubt`: it died, so its last pulse may have been at any time since."""
        remembered_s = None if in_doubt else self._read()
        if remembered_s is not None:
            self.last_pulse_s = remembered_s
        elif in_doubt or self._path.exists() or self._used():
            self.pulse_at(self._clock.now_s(), ended=False)

    def pulse_at(self, time_s: float, ended: bool = True) -> None:
        """Remember a pulse at that time; where the disk refuses, the next start is in doubt.

        `ended` is False where the end of stimulation is not confirmed: a line that stalls may still hold a pulse.
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
            with contextlib.suppress(OSError):  # a disk that is read-only now: the latch says that a test ran
                self._path.unlink(missing_ok=True)

    def settle(self) -> None:
        """The stimulator has answered: what the line held is through, perhaps only now."""
        if not self._ended:
            self.pulse_at(self._clock.now_s())

    def check(self, test: PlannedTest, limit: limits.Limit) -> None:
        """Time enough between the last pulse that was sent and the first that is planned? Raises RefusedError."""
        planned = test.pulse_width_us > 0
        if self.last_pulse_s is None or not planned.any():
            return
        first_s = float(planned.argmax()) / test.plan.pulse_rate_hz + LEAD_S * self._clock.speed
        rest_s = self._clock.now_s() + first_s - self.last_pulse_s
        refusal = limits.check(limit, rest_s)
        if refusal is not None:
            raise RefusedError(f"plan: {refusal}; wait {limit.lo - rest_s:.1f} s")

    def _read(self) -> float | None:
        """The time that was left, if it is beyond doubt of this boot."""
        try:
            content = json.loads(self._path.read_text("utf-8"))
            here, monotonic_s = boot_id(), float(content["monotonic_s"])
            certain = bool(here) and content["boot_id"] == here and content["ended"] is True
        except (OSError, ValueError, KeyError, TypeError):
            return None
        time_s = monotonic_s * self._clock.speed
        return time_s if certain and 0 <= time_s <= self._clock.now_s() else None

    def _used(self) -> bool:
        """Was anything ever played from this folder? One of an older version has no file of the last pulse."""
        return any(any((self._folder / name).glob("*")) for name in ("recordings", "journals"))


def boot_id() -> str:
    """Which start of this machine this is; empty where the system does not say."""
    try:
        return BOOT_ID.read_text("ascii").strip()
    except (OSError, ValueError):
        return ""
