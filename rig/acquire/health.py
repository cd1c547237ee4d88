"""Health checks that must pass before the next pulse is sent or a device's watchdog is fed.

Nothing here runs by itself. The sender asks before each pulse, rests included; the answer decides whether it sends and
feeds the watchdog, or stops. A sender that hangs does not ask, so it neither sends nor feeds.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rig.acquire.receiver import Receiver
from rig.clock import Clock
from rig.gate import Gate
from rig.journal import Journal

SYNC_PERIOD_S = 0.5
STALL_S = 0.25
"""Real seconds: if the sender is later than this, the test ends."""
MIN_FREE_BYTES = 8 * 2**20
"""With less than this a running test ends, while its recording can still be sealed."""


@dataclass(frozen=True, slots=True)
class Watch:
    """When silence counts as a fault, real seconds, and when a pulse is too late, as a share of the pulse period."""

    stale_torque_s: float = 0.1
    missing_ack_s: float = 0.1
    late_pulse_periods: float = 0.4
    stale_disk_s: float = 3.0
    stuck_torque_s: float = 0.5
    clipped_torque_s: float = 3.0
    stale_angle_s: float = 0.1


DEFAULT_WATCH = Watch()


class Disk:
    """Syncs the journal to the disk twice a second in a thread of its own, and keeps the time of the last success.

    Times are real seconds, since a disk does not follow the rig's clock.
    """

    def __init__(self, journal: Journal, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.free_bytes = MIN_FREE_BYTES
        self._journal = journal
        self._monotonic = monotonic
        self._proof_s = monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal-sync", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._done.wait(SYNC_PERIOD_S):
            self._journal.sync()
            try:
                found = os.statvfs(self._journal.path.parent)
            except OSError:
                continue  # keeps the time of the last success
            self.free_bytes = found.f_bavail * found.f_frsize
            self._proof_s = self._monotonic()

    def age_s(self) -> float:
        """Real seconds since the journal was last synced to the disk."""
        return self._monotonic() - self._proof_s

    def end(self) -> None:
        """Wait for the thread to end."""
        self._done.set()
        self._thread.join()


class Health:
    """All checks together."""

    def __init__(
        self,
        gate: Gate,
        receiver: Receiver,
        disk: Disk,
        clock: Clock,
        watch: Watch,
        angle: Callable[[], str | None] = lambda: None,
    ) -> None:
        self._gate, self._receiver, self._disk, self._clock, self._watch = gate, receiver, disk, clock, watch
        self._angle = angle

    def fault(self, due_s: float) -> str | None:
        """What is wrong, in words; None: all checks pass.

        Parameters
        ----------
        due_s
            When the sender should have asked; its own lateness is checked, too.
        """
        now_s, speed, watch = self._clock.now_s(), self._clock.speed, self._watch
        late_s = (now_s - due_s) / speed
        if not (late_s <= STALL_S):
            return f"the computer was blocked for {late_s:.1f} s; close other programs"
        age_s = self._receiver.age_s(now_s) / speed
        if not (age_s <= watch.stale_torque_s):
            return f"load cell: torque is stale, the newest sample is {age_s * 1e3:.0f} ms old"
        if (wrong := self._angle()) is not None:
            return wrong
        pulse = self._gate.on_its_way
        if pulse is not None and not ((now_s - pulse.written_s) / speed <= watch.missing_ack_s):
            return f"stimulator: a pulse was not acknowledged within {watch.missing_ack_s * 1e3:.0f} ms"
        if not (self._disk.age_s() <= watch.stale_disk_s):
            return f"disk: the journal could not be written for {watch.stale_disk_s:g} s; the disk is too slow or gone"
        if not (self._disk.free_bytes >= MIN_FREE_BYTES):
            return f"disk: {self._disk.free_bytes / 2**20:.1f} MB free, too little to go on; move old recordings away"
        return None
