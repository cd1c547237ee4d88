"""Data for a page's chart: envelope of the torque, and the pulses, since the last event."""

from __future__ import annotations

import numpy as np

from rig.acquire.receiver import Receiver
from rig.acquire.run import TestRun
from rig.messages import LiveEvent

BIN_S = 0.01


def live_event(
    receiver: Receiver, run: TestRun | None, origin_s: float, now_s: float, first_pulse: int
) -> LiveEvent | None:
    """The newest torque as minimum and maximum of bins of 10 ms, or None if there is none.

    Parameters
    ----------
    run
        The test in progress; None when idle.
    origin_s
        Rig time that counts as zero: the test's start, or the rig's when idle.
    first_pulse
        Index of the first pulse that earlier events did not contain.
    """
    blocks = []
    while receiver.live:
        blocks.append(receiver.live.popleft())
    if not blocks:
        return None
    samples = np.concatenate(blocks)
    time_s = samples["host_time_s"] - origin_s
    bins = np.floor(time_s / BIN_S)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(bins) > 0) + 1])
    torque_nm = samples["torque_nm"]
    pulses = range(0)
    if run is not None and run.t0_s is not None:
        reached = int(np.floor((now_s - run.t0_s) * run.test.plan.pulse_rate_hz)) + 1
        pulses = range(first_pulse, max(first_pulse, min(reached, len(run.test.pulse_width_us))))
    rate_hz = run.test.plan.pulse_rate_hz if run else 1.0
    elapsed_s = run.elapsed_s() if run else 0.0
    return LiveEvent(
        test_id=run.test.plan.test_id if run else None,
        segment=run.segment() if run else None,
        elapsed_s=elapsed_s,
        duration_s=run.test.duration_s if run else 0.0,
        time_s=np.round(bins[starts] * BIN_S, 4).tolist(),
        torque_min_nm=_finite(np.fmin.reduceat(torque_nm, starts)),
        torque_max_nm=_finite(np.fmax.reduceat(torque_nm, starts)),
        pulse_time_s=[i / rate_hz for i in pulses],
        pulse_width_us=[float(run.test.pulse_width_us[i]) for i in pulses] if run else [],
        torque_age_s=max(0.0, receiver.age_s(now_s)),
        lost_samples=receiver.counts.lost_samples,
        dropped_pulses=run.dropped if run else 0,
        sent_pulses=run.sent if run else 0,
        charge_uc=run.charge_uc if run else 0.0,
    )


def _finite(values: np.ndarray) -> list[float]:
    """JSON has no NaN: a bin without a number is set to zero; the fault is reported elsewhere."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0).round(5).tolist()
