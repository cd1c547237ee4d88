"""What a test asks of the joint's angle while it runs, and what it hears of a sensor that it does not need."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from stimrig.rig.acquire.angle_check import AngleCheck, degrees, outside
from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.health import Watch
from stimrig.rig.clock import Clock
from stimrig.rig.errors import DeviceError, JournalError, RefusedError
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.limits import Limit, check
from stimrig.rig.messages import TestPlan
from stimrig.rig.signals import Recorded
from stimrig.rig.tasks import Tasks

AROUND_S = 0.1
"""Real seconds over which the median tells where the joint is before a test."""
PATIENCE_S = 2.0
"""Real seconds to wait for a sensor that was just plugged in, or a rig that was just started."""


class AngleGuard:
    """The angle sensor during one test.

    Parameters
    ----------
    receiver
        None: the rig has no angle sensor.
    """

    def __init__(
        self, receiver: AngleReceiver | None, plan: TestPlan, table: dict[str, Limit], clock: Clock, watch: Watch
    ) -> None:
        self._receiver, self._clock, self._watch = receiver, clock, watch
        self.needed = plan.angle is not None
        """Whether a fault of the angle ends the test."""
        self._journal: Journal | None = None
        self._noted = False
        self._check: AngleCheck | None = None
        if receiver is not None:
            self._check = AngleCheck(plan, table, receiver.nominal_rate_hz, clock.speed)

    def record(self, journal: Journal, on_fault: Callable[[str], None]) -> None:
        """Write every sample from now on; `on_fault` gets what must end the test."""
        self._journal = journal
        if self._receiver is not None and self._check is not None:
            self._receiver.record(journal, self._check, on_fault if self.needed else self._note, on_fault)

    def release(self) -> Recorded | None:
        """Stop recording; returns the counts, None without a sensor."""
        return None if self._receiver is None else self._receiver.release()

    def fresh(self) -> bool:
        """Whether the test may begin: the newest angle is of now, or none is needed."""
        return not self.needed or self._stale() is None

    def begin(self) -> None:
        """What waited in buffers has been read."""
        if self._check is not None:
            self._check.rate.begin()

    def started(self) -> None:
        """The test's clock runs."""
        if self._check is not None:
            self._check.started()

    def fault(self) -> str | None:
        """What must end the test; asked before each pulse, rests included. None: nothing."""
        return self._ending(self._stale())

    def fault_at_end(self) -> str | None:
        """What only the whole test shows, and must make it a fault."""
        return self._ending(None if self._check is None else self._check.rate.fault_at_end())

    def _ending(self, found: str | None) -> str | None:
        """What was found, if this test needs the sensor; else it is noted."""
        if found is not None and not self.needed:
            self._note(found)
        return found if self.needed else None

    def _stale(self) -> str | None:
        if self._receiver is None:
            return "angle sensor: this rig has none" if self.needed else None
        age_s = self._receiver.data_age_s(self._clock.now_s()) / self._clock.speed
        if age_s <= self._watch.stale_angle_s:
            return None
        if not np.isfinite(age_s):
            return _worded(self._receiver)
        return f"angle sensor: the angle is stale, the newest one is {age_s * 1e3:.0f} ms old"

    def _note(self, reason: str) -> None:
        """The first trouble of a sensor that this test does not need stands in its recording."""
        if not self._noted and self._journal is not None:
            self._noted = True
            event = {"event": "angle_trouble", "reason": reason, "time_s": self._clock.now_s()}
            with contextlib.suppress(JournalError):  # whoever writes a pulse or a sample next reports it
                self._journal.append_json(Kind.EVENT, event)


def _worded(receiver: AngleReceiver) -> str:
    """Why a sensor gives nothing."""
    found = receiver.problem or "angle sensor: no angle arrives; check its cable and supply"
    return found if found.startswith("angle sensor") else f"angle sensor: {found}"


async def await_angle(receiver: AngleReceiver, tasks: Tasks) -> None:
    """Wait a moment for the first angle: right after connecting there is none."""
    clock = tasks.clock
    end_s = clock.now_s() + PATIENCE_S * clock.speed
    while receiver.angle_around(AROUND_S * clock.speed) is None and clock.now_s() <= end_s:
        await tasks.sleep(0.02)


def check_start(receiver: AngleReceiver, plan: TestPlan, table: dict[str, Limit], clock: Clock) -> None:
    """Check where the joint is before a test that asks for its angle.

    Raises
    ------
    DeviceError
        No angle arrives.
    RefusedError
        It is outside the range, or away from the target; says by how much.
    """
    if plan.angle is None:
        return
    now_rad = receiver.angle_around(AROUND_S * clock.speed)
    if now_rad is None:
        raise DeviceError(_worded(receiver))
    bound, target_rad, tolerance_rad = table["angle_rad"], plan.angle.target_rad, plan.angle.tolerance_rad
    if check(bound, now_rad) is not None:
        raise RefusedError(f"plan.angle: {outside(now_rad, bound)}; move the joint into it")
    if target_rad is not None and not (abs(now_rad - target_rad) <= tolerance_rad):
        raise RefusedError(
            f"plan.angle: the joint is at {degrees(now_rad)}, this test needs {degrees(target_rad)} ± "
            f"{degrees(tolerance_rad)}; move it there"
        )
