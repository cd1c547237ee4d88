"""News since the last live event: torque and angle samples as they came, and the outcomes of the pulses."""

from __future__ import annotations

import math
from base64 import b64encode
from collections import deque
from typing import Any

from numpy.typing import NDArray

from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.run import TestRun
from stimrig.rig.gate import Done
from stimrig.rig.messages import LaidSegment, LiveEvent, PulseOutcomes

IDLE: dict[str, Any] = {"test_id": None, "segment": None, "elapsed_s": 0.0, "duration_s": 0.0, "dropped_pulses": 0}


def live_event(
    receiver: Receiver, run: TestRun | None, zero_s: float, now_s: float, angle: AngleReceiver | None
) -> LiveEvent | None:
    """Return what is new, or None if there is no new torque. Numbers are only copied: no pulse waits for it.

    `run`: the test in progress; None when idle, and as long as its clock does not run. `zero_s`: rig time that counts
    as zero: the test's start, or the rig's when idle. `angle`: None: the rig has no angle sensor.
    """
    torque = _emptied(receiver.live)
    if not torque:
        return None
    fields: dict[str, Any] = {
        "zero_s": zero_s,
        "torque": torque,
        "torque_age_s": max(0.0, receiver.age_s(now_s)),
        "lost_samples": receiver.counts.lost_samples,
    }
    if angle is not None:
        fields |= {
            "angle_rad": finite(angle.angle_rad), "velocity_rad_s": finite(angle.velocity_rad_s),
            "angle": _emptied(angle.live),
        }  # fmt: skip
    return LiveEvent(**fields, **(IDLE if run is None else _of_run(run, zero_s, now_s)))


def _emptied(queue: deque[NDArray[Any]]) -> str:
    rows = []
    while queue:
        rows.append(queue.popleft().tobytes())
    return b64encode(b"".join(rows)).decode()


def _of_run(run: TestRun, zero_s: float, now_s: float) -> dict[str, Any]:
    elapsed_s = max(0.0, now_s - zero_s)
    done = run.gate.done[run.told_pulses :]
    run.told_pulses += len(done)
    rate_hz = run.plan.pulse_rate_hz
    segments = run.score.queue.segments if run.score.adaptive else ()  # they hold every pulse before
    return {
        "test_id": run.plan.test_id,
        "segment": run.score.segment_at(elapsed_s),
        "elapsed_s": elapsed_s,
        "duration_s": run.score.longest_s,
        "dropped_pulses": run.gate.dropped,
        "sent_pulses": run.sent,
        "charge_uc": run.gate.charge_uc,
        "torque_time_nms": finite(run.torque_time_nms) or 0.0,
        "laid": run.score.decided,
        "boundary_s": run.score.decided / rate_hz,
        "ended_by": run.ended_by,
        "pauses": run.pauses.all if run.pauses else [],
        "pulse_rate_hz": rate_hz,
        "outcomes": _outcomes(done, zero_s),
        "laid_segments": [
            LaidSegment(name=name, start_s=start / rate_hz, end_s=end / rate_hz, by=by)
            for name, start, end, by in segments
        ],
    }


def _outcomes(done: list[Done], zero_s: float) -> PulseOutcomes:
    def times(name: str) -> list[float | None]:
        return [finite(round(getattr(pulse, name) - zero_s, 6)) for pulse in done]

    return PulseOutcomes(
        index=[pulse.index for pulse in done],
        pulse_width_us=[pulse.pulse_width_us for pulse in done],
        written_time_s=times("written_s"),
        acknowledged_time_s=times("acknowledged_s"),
        status=[int(pulse.status) for pulse in done],
    )


def finite(value: float | None) -> float | None:
    """JSON has no NaN and no infinity: None."""
    return value if value is not None and math.isfinite(value) else None
