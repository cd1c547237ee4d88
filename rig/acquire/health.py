"""Health checks that must pass before the next pulse is sent or a device's watchdog is fed.

Nothing here runs by itself. The sender asks before each pulse, rests included; the answer decides whether it sends and
feeds the watchdog, or stops. A sender that hangs does not ask, so it neither sends nor feeds.
"""

from __future__ import annotations

from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field

from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.stream import LOOK_AT
from stimrig.rig.clock import Clock
from stimrig.rig.errors import JournalError
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Journal
from stimrig.rig.machine import Machine
from stimrig.rig.tasks import Signal

SYNC_PERIOD_S = 0.5
MIN_FREE_BYTES = 8 * 2**20
"""With less than this a running test ends, while its recording can still be sealed."""


class Watch(BaseModel):
    """When silence counts as a fault, real seconds, and when a pulse is too late, as a share of the pulse period.

    A rig file may make it tighter or slightly looser than the defaults. Types are strict: `true` is not a number.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, frozen=True)

    stale_torque_s: float = Field(0.1, gt=0, le=0.5)
    missing_ack_s: float = Field(0.1, gt=0, le=0.5)
    late_pulse_periods: float = Field(0.15, gt=0, le=0.6)
    stuck_torque_s: float = Field(0.5, gt=0.05, le=10)
    unmoved_torque_s: float = Field(10.0, gt=0.5, le=3600)
    clipped_torque_s: float = Field(3.0, gt=0.05, le=10)
    stale_disk_s: float = Field(3.0, gt=0.5, le=10)
    stale_angle_s: float = Field(0.1, gt=0, le=0.5)


DEFAULT_WATCH = Watch.model_validate({})


class DiskWatch:
    """Syncs the journal to the disk twice a second, and keeps the time of the last success.

    Its times are real seconds, since a disk does not follow the rig's clock.
    """

    def __init__(self, journal: Journal, machine: Machine) -> None:
        self.free_bytes = MIN_FREE_BYTES
        self._journal, self._disk, self._tasks = journal, machine.disk, machine.tasks
        self._proof_s = self._now_s()
        self._ended = Signal()
        self._task = machine.tasks.spawn(self._run(), "journal sync")

    def _now_s(self) -> float:
        return self._tasks.clock.now_s() / self._tasks.clock.speed

    async def _run(self) -> None:
        while not await self._tasks.sleep(SYNC_PERIOD_S, self._ended):
            try:
                self.free_bytes = await self._tasks.work(self._sync)
            except (OSError, JournalError):
                continue  # keeps the time of the last success; the next pulse finds the journal's failure
            self._proof_s = self._now_s()

    def _sync(self) -> int:
        self._journal.sync()
        return self._disk.free_bytes(self._journal.path.parent)

    def age_s(self) -> float:
        """Real seconds since the journal was last synced to the disk."""
        return self._now_s() - self._proof_s

    async def end(self) -> None:
        """Wait until nothing is being synced any more."""
        self._ended.set()
        await self._tasks.join(self._task)


class Health:
    """All checks together."""

    def __init__(
        self,
        gate: Gate,
        receiver: Receiver,
        disk: DiskWatch,
        clock: Clock,
        watch: Watch,
        angle: Callable[[float], str | None],
    ) -> None:
        self._gate, self._receiver, self._disk, self._clock, self._watch = gate, receiver, disk, clock, watch
        self._angle = angle

    def suspicion(self) -> tuple[str, float] | None:
        """Why the first pulse may not come yet, and for how long it may be waited for; see `Receiver.suspicion`."""
        return self._receiver.suspicion(self._watch.stuck_torque_s, self._watch.unmoved_torque_s)

    def fault(self, stood_s: float = 0.0) -> str | None:
        """Return the first fault in words; None: all checks pass.

        `stood_s`: real seconds for which this computer has just stood still: what came meanwhile could not be taken, so
        a silence counts without them.
        """
        now_s, speed, watch = self._clock.now_s(), self._clock.speed, self._watch
        age_s = self._receiver.age_s(now_s) / speed - stood_s
        if not (age_s <= watch.stale_torque_s):
            return f"load cell: torque is stale, the newest sample is {age_s * 1e3:.0f} ms old; {LOOK_AT}"
        if (wrong := self._angle(stood_s)) is not None:
            return wrong
        pulse = self._gate.on_its_way
        if pulse is not None and not ((now_s - pulse.written_s) / speed - stood_s <= watch.missing_ack_s):
            return f"stimulator: a pulse was not acknowledged within {watch.missing_ack_s * 1e3:.0f} ms"
        if not (self._disk.age_s() <= watch.stale_disk_s):
            return f"disk: the journal could not be written for {watch.stale_disk_s:g} s; the disk is too slow or gone"
        if not (self._disk.free_bytes >= MIN_FREE_BYTES):
            return f"disk: {self._disk.free_bytes / 2**20:.1f} MB free, too little to go on; move old recordings away"
        return None
