"""A computer that stands still in a test: the one place that decides whether the test goes on.

While nothing runs, no pulse is sent, so no current flows: each stimulator that we drive fires one pulse a command. A
short standstill is therefore a gap in the record and no fault. Before the next pulse all is looked at anew: torque of
now arrives at its own pace, the angle too, the last pulse was acknowledged, the disk takes the journal, and the
stimulator says that it is as it was when armed. What is not whole in time ends the test, as do a longer standstill, and
long ones again and again (docs/safety/hazards.toml, H33).
"""

from __future__ import annotations

from collections import deque

from stimrig.rig.acquire.health import Health
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Journal, Kind
from stimrig.rig.machine import Machine
from stimrig.rig.messages import Pause
from stimrig.rig.tasks import POLL_S, Signal

BLOCKED_S = 0.1
"""Real seconds: a sender that is later was kept from running."""
LONGEST_S = 1.0
"""Real seconds: a longer standstill ends the test."""
RECOVERY_S = 0.5
"""Real seconds more within which all must be whole again, however often it stood still meanwhile."""
LONG_S, MOST_LONG, WITHIN_S = 0.9, 3, 10.0
"""So many standstills, each nearly as long as the longest, within so many real seconds end the test."""


class Pauses:
    """Those of one test. `halt`: set when the test is being ended."""

    def __init__(
        self, health: Health, gate: Gate, receiver: Receiver, journal: Journal, machine: Machine, halt: Signal
    ) -> None:
        self._health, self._gate, self._receiver, self._journal = health, gate, receiver, journal
        self._machine, self._tasks, self._clock, self._halt = machine, machine.tasks, machine.tasks.clock, halt
        self._machine.blocked_by(0.0)  # what comes from now on is counted
        self._long: deque[float] = deque(maxlen=MOST_LONG)
        self.until_s = -1e9
        """When the newest one ended, rig time."""
        self.all: list[Pause] = []

    async def fault(self, due_s: float, t0_s: float, first: bool = False) -> str | None:
        """Return the fault that must end the test before the due pulse; None: no fault, or the test is ending.

        After a standstill it returns once all is whole again. `due_s`: when the sender should have asked; what came due
        in a pause is not asked about again. `first`: the first pulse is due: with a doubt of the torque it waits as
        after a standstill.
        """
        if due_s < self.until_s:
            return None
        stood_s = self._since(due_s)
        if stood_s <= BLOCKED_S and self._health.fault() is None and not (first and self._health.suspicion()):
            return None
        return self._too_much(stood_s, due_s) or await self._sit_out(stood_s, due_s, t0_s, first)

    async def _sit_out(self, stood_s: float, due_s: float, t0_s: float, first: bool) -> str | None:
        """Wait until all is whole at one moment. Nothing is sent meanwhile, and the device's watchdog is not fed.

        The stimulator is asked beside it: who stops waits for no answer of it.
        """
        longest_s, looked_s, cause = stood_s, 0.0, self._machine.blocked_by(stood_s)
        changing = self._tasks.spawn(self._gate.changed(), "stimulator after a pause")
        while True:
            suspicion = self._health.suspicion() if first else None
            if (
                changing.done.is_set()
                and self._receiver.settled()
                and suspicion is None
                and self._health.fault() is None
            ):
                break
            is_over = self._since(due_s) > LONGEST_S + RECOVERY_S
            if suspicion is not None and (is_over or looked_s >= suspicion[1]):
                return suspicion[0]
            if is_over:
                return self._health.fault() or "not everything was in order again soon after the computer was blocked"
            now_s = self._clock.now_s()
            looked_s += await self._tasks.look_again(self._halt)
            if self._halt.is_set():
                return None
            again_s = self._since(now_s) - POLL_S
            if again_s > BLOCKED_S:  # it stood still once more
                longest_s = max(longest_s, again_s)
                if (wrong := self._too_much(again_s, due_s)) is not None:
                    return wrong
        if (wrong := changing.result) is None:
            self.until_s = self._clock.now_s()
            pause = Pause(at_s=due_s - t0_s, for_s=self.until_s - due_s, blocked_s=longest_s, cause=cause)
            self.all.append(pause)
            event = {"event": "pause", "time_s": self.until_s, **pause.model_dump()}
            self._journal.append_json(Kind.EVENT, event)
        return wrong

    def _too_much(self, stood_s: float, due_s: float) -> str | None:
        """Why a standstill is no pause: it was too long, it comes too often, or something failed before it."""
        silent_s = self._receiver.age_s(self._clock.now_s()) / self._clock.speed  # it may have begun before the pulse
        if not (stood_s <= LONGEST_S) or (stood_s > BLOCKED_S and silent_s > LONGEST_S + BLOCKED_S):
            return f"the computer was blocked for {max(stood_s, silent_s):.1f} s; close other programs"
        if stood_s > LONG_S:
            self._long.append(self._clock.now_s())
            if len(self._long) == MOST_LONG and self._since(self._long[0]) <= WITHIN_S:
                return f"the computer was blocked {MOST_LONG} times within {WITHIN_S:.0f} s; close other programs"
        return self._health.fault(self._since(due_s))

    def _since(self, time_s: float) -> float:
        """Real seconds since a rig time."""
        return (self._clock.now_s() - time_s) / self._clock.speed
