"""Proof of health: what must be so, and recent, before the next pulse may go or a device's watchdog be fed.

Nothing here keeps anything alive by itself. The sender asks before each pulse, rests included; what it is told decides
whether it sends and feeds, or stops. A sender that hangs asks nothing, sends nothing and feeds nothing.
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
"""Real seconds of lateness that are no hiccup any more: a test with such a hole ends."""
MIN_FREE_BYTES = 8 * 2**20
"""Less than this while a test runs, and it ends while its recording can still be sealed."""


@dataclass(frozen=True, slots=True)
class Watch:
    """When silence counts as a fault, real seconds, and when a pulse is too late, as a share of the period."""

    stale_torque_s: float = 0.1
    missing_ack_s: float = 0.1
    late_pulse_periods: float = 0.4
    stale_disk_s: float = 3.0
    stuck_torque_s: float = 0.5
    clipped_torque_s: float = 3.0


DEFAULT_WATCH = Watch()


class Disk:
    """Brings the journal to the disk twice a second, in a thread of its own, and remembers when that last went well.

    In real seconds: a disk knows no rig clock.
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
                continue  # no proof
            self.free_bytes = found.f_bavail * found.f_frsize
            self._proof_s = self._monotonic()

    def age_s(self) -> float:
        """Real seconds since the journal was last brought to the disk."""
        return self._monotonic() - self._proof_s

    def end(self) -> None:
        """Bring the rest to the disk."""
        self._done.set()
        self._thread.join()


class Health:
    """The proofs together."""

    def __init__(self, gate: Gate, receiver: Receiver, disk: Disk, clock: Clock, watch: Watch) -> None:
        self._gate, self._receiver, self._disk, self._clock, self._watch = gate, receiver, disk, clock, watch

    def wrong(self, due_s: float) -> str | None:
        """What is not well, in words; None: all proofs are there, and fresh.

        Parameters
        ----------
        due_s
            When the sender should have asked: its own lateness is proof that it lives.
        """
        now_s, speed, watch = self._clock.now_s(), self._clock.speed, self._watch
        late_s = (now_s - due_s) / speed
        if not (late_s <= STALL_S):
            return f"the computer stood still for {late_s:.1f} s; what else runs on it?"
        age_s = self._receiver.age_s(now_s) / speed
        if not (age_s <= watch.stale_torque_s):
            return f"load cell: torque is stale, the newest sample is {age_s * 1e3:.0f} ms old"
        pulse = self._gate.on_its_way
        if pulse is not None and not ((now_s - pulse.written_s) / speed <= watch.missing_ack_s):
            return f"stimulator: a pulse was not acknowledged within {watch.missing_ack_s * 1e3:.0f} ms"
        if not (self._disk.age_s() <= watch.stale_disk_s):
            return f"disk: the journal could not be brought to it for {watch.stale_disk_s:g} s; it is too slow or gone"
        if not (self._disk.free_bytes >= MIN_FREE_BYTES):
            return f"disk: {self._disk.free_bytes / 2**20:.1f} MB free, too little to go on; move old recordings away"
        return None
