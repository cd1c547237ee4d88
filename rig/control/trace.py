"""When a traced request passed its steps, for who asked. Tracing decides nothing and plays no part in a test.

A rig has no network: it exports nothing, but tells these times back on its socket. Nothing is noted between the first
pulse of a test and its end; the sender knows nothing of this. What is told of pulses is what the gate has of each.
"""

from __future__ import annotations

import logging
import math
import re
import time

from stimrig.rig.acquire.run import RunResult, TestRun
from stimrig.rig.clock import Clock
from stimrig.rig.messages import StopAnswer, StopEvidence, Traced

log = logging.getLogger("rig")
_TRACEPARENT = re.compile(r"00-(?!0{32})[0-9a-f]{32}-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")


def sound(given: object) -> str:
    """A W3C trace context as it came; empty where it is none, which is no error."""
    return given if isinstance(given, str) and _TRACEPARENT.fullmatch(given) else ""


class Steps:
    """The steps of a start, on the rig's clock."""

    def __init__(self, traceparent: object, clock: Clock) -> None:
        self._traceparent, self._clock = sound(traceparent), clock
        self._at_s = {"received": clock.now_s()}

    def passed(self, step: str) -> None:
        """This step is done now."""
        self._at_s[step] = self._clock.now_s()

    def told(self, run: TestRun, result: RunResult) -> Traced | None:
        """All steps of a test that was played, in host's UTC; None where nobody traces it."""
        if not self._traceparent:
            return None
        try:
            self.passed("sealed")
            if run.t0_s is not None:
                self._at_s |= {"begun": run.t0_s, "ended": run.t0_s + result.summary["duration_s"]}
            first = next((done for done in run.gate.done if not math.isnan(done.written_s)), None)
            if first is not None:
                self._at_s |= {"first_sent": first.written_s, "first_acknowledged": first.acknowledged_s}
            now_s, unix_s, speed = self._clock.now_s(), self._clock.unix_s(), self._clock.speed
            known = {step: at_s for step, at_s in self._at_s.items() if math.isfinite(at_s)}
            at_unix_s = {step: unix_s - (now_s - at_s) / speed for step, at_s in known.items()}
            return Traced(traceparent=self._traceparent, at_unix_s=at_unix_s)
        except Exception:  # whatever it is: the test was played and sealed
            log.exception("the steps of a test could not be told")
            return None


def with_steps(evidence: StopEvidence, traceparent: object, received_unix_s: float) -> StopAnswer:
    """A stop's evidence, with its times where somebody traces it."""
    answer = StopAnswer.model_construct(**dict(evidence))
    if not (known := sound(traceparent)):
        return answer
    at_unix_s = {"received": received_unix_s, "confirmed": time.time()}
    return answer.model_copy(update={"traced": Traced(traceparent=known, at_unix_s=at_unix_s)})
