"""Data for a page's chart: envelope of the torque, and the pulses, since the last event."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.run import TestRun
from stimrig.rig.messages import LatePulse, LiveEvent, TorqueSamples

BIN_S = 0.01
IDLE = {
    "test_id": None, "segment": None, "elapsed_s": 0.0, "duration_s": 0.0, "pulse_time_s": [], "pulse_width_us": [],
    "dropped_pulses": 0,
}  # fmt: skip


def live_event(
    receiver: Receiver, run: TestRun | None, origin_s: float, now_s: float, samples: bool, angle: AngleReceiver | None
) -> LiveEvent | None:
    """The newest torque as minimum and maximum of bins of 10 ms, or None if there is none.

    Parameters
    ----------
    run
        The test in progress; None when idle.
    origin_s
        Rig time that counts as zero: the test's start, or the rig's when idle.
    samples
        Whether every sample is wanted, too.
    angle
        The angle sensor's receiver; None: the rig has none.
    """
    blocks = []
    while receiver.live:
        blocks.append(receiver.live.popleft())
    if not blocks:
        return None
    found = np.concatenate(blocks)
    bins = np.floor((found["host_time_s"] - origin_s) / BIN_S)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(bins) > 0) + 1])
    torque_nm = found["torque_nm"]
    return LiveEvent(
        time_s=np.round(bins[starts] * BIN_S, 4).tolist(),
        torque_min_nm=_finite(np.fmin.reduceat(torque_nm, starts)),
        torque_max_nm=_finite(np.fmax.reduceat(torque_nm, starts)),
        torque_age_s=max(0.0, receiver.age_s(now_s)),
        lost_samples=receiver.counts.lost_samples,
        samples=_samples(found, origin_s) if samples else None,
        **({} if angle is None else _angle_fields(angle, origin_s, samples)),
        **(IDLE if run is None else _run_fields(run, now_s, samples)),
    )


def _run_fields(run: TestRun, now_s: float, samples: bool) -> dict[str, Any]:
    rate_hz, laid = run.plan.pulse_rate_hz, run.score.laid
    reached = 0 if run.t0_s is None else int(np.floor((now_s - run.t0_s) * rate_hz)) + 1
    pulses = range(run.told_pulses, max(run.told_pulses, min(reached, len(laid))))
    found: dict[str, Any] = {
        "test_id": run.plan.test_id,
        "segment": run.segment(),
        "elapsed_s": run.elapsed_s(),
        "duration_s": run.score.longest_s,
        "pulse_time_s": [index / rate_hz for index in pulses],
        "pulse_width_us": laid.pulse_width_us[pulses.start : pulses.stop].tolist(),
        "dropped_pulses": run.gate.dropped,
        "sent_pulses": run.sent,
        "charge_uc": run.gate.charge_uc,
        "torque_time_nms": float(np.nan_to_num(run.torque_time_nms)),
        "laid": len(laid),
        "boundary_s": len(laid) / rate_hz,
        "ended_by": run.ended_by,
    }
    if run.score.adaptive:  # whoever chooses its pieces needs these; the segments last: they hold every pulse before
        late = tuple(run.gate.late) if samples else ()
        found["not_sent"] = list(run.gate.not_sent)
        found["late"] = [LatePulse(index=index, by_s=round(by_s, 6)) for index, by_s in late]
        found["laid_segments"] = run.score.segments()
    return found


def _samples(found: NDArray[Any], origin_s: float) -> TorqueSamples:
    torque_nm = found["torque_nm"].round(6).tolist()
    return TorqueSamples(
        host_time_s=(found["host_time_s"] - origin_s).round(6).tolist(),
        counter=found["counter"].tolist(),
        torque_nm=[value if math.isfinite(value) else None for value in torque_nm],
    )


def _angle_fields(angle: AngleReceiver, origin_s: float, samples: bool) -> dict[str, Any]:
    """The newest angle, and all since the last event if they are wanted."""
    rows: list[list[float | None]] = []
    while angle.live:
        block = angle.live.popleft()
        if samples:
            block = (block - [origin_s, 0.0, 0.0]).round(6).tolist()
            rows += [[row[0], finite(row[1]), finite(row[2])] for row in block]
    newest = {"angle_rad": finite(angle.angle_rad), "velocity_rad_s": finite(angle.velocity_rad_s)}
    return {**newest, "angle": rows if samples else None}


def finite(value: float | None) -> float | None:
    """JSON has no NaN and no infinity: None."""
    return value if value is not None and math.isfinite(value) else None


def _finite(values: np.ndarray) -> list[float]:
    """JSON has no NaN: a bin without a number is set to zero; the fault is reported elsewhere."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0).round(5).tolist()
