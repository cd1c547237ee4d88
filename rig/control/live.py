"""Data for a page's chart: envelope of the torque, and the pulses as they were sent, since the last event.

The rig's process only takes what is new (`take`). Another one makes the event of it and its JSON (`serve`), so that no
pulse waits for either.
"""

from __future__ import annotations

import logging
import math
import pickle
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stimrig.rig.acquire.angle_receiver import AngleReceiver
from stimrig.rig.acquire.receiver import Receiver
from stimrig.rig.acquire.run import TestRun
from stimrig.rig.control.replies import to_line
from stimrig.rig.gate import Done
from stimrig.rig.messages import LaidSegment, LiveEvent, PulseOutcomes, TorqueSamples

log = logging.getLogger("rig.live")

BIN_S = 0.01
IDLE = {"test_id": None, "segment": None, "elapsed_s": 0.0, "duration_s": 0.0, "dropped_pulses": 0}


class Taken(NamedTuple):
    """What is new since the last time, as arrays and plain values."""

    fields: dict[str, Any]  # of the event, as they are
    origin_s: float
    samples: bool
    blocks: list[NDArray[Any]]  # of torque, as they came
    angles: list[NDArray[Any]] | None  # None: the rig has no angle sensor
    done: list[Done]  # pulses of which it is known what became of them
    segments: tuple[tuple[Any, ...], ...] = ()  # of the test; of one that is not adaptive none
    pulse_rate_hz: float = 1.0


def take(
    receiver: Receiver, run: TestRun | None, origin_s: float, now_s: float, samples: bool, angle: AngleReceiver | None
) -> Taken | None:
    """What is new, or None if there is no new torque.

    Parameters
    ----------
    run
        The test in progress; None when idle, and as long as its clock does not run.
    origin_s
        Rig time that counts as zero: the test's start, or the rig's when idle.
    samples
        Whether every sample is wanted, too.
    angle
        The angle sensor's receiver; None: the rig has none.
    """
    blocks = _emptied(receiver.live)
    if not blocks:
        return None
    fields = {"torque_age_s": max(0.0, receiver.age_s(now_s)), "lost_samples": receiver.counts.lost_samples}
    if angle is not None:
        fields |= {"angle_rad": finite(angle.angle_rad), "velocity_rad_s": finite(angle.velocity_rad_s)}
    angles = None if angle is None else _emptied(angle.live)
    if run is None:
        return Taken({**fields, **IDLE}, origin_s, samples, blocks, angles, [])
    done = run.gate.done[run.told_pulses :]
    run.told_pulses += len(done)
    segments = run.score.laid.segments if run.score.adaptive else ()  # they hold every pulse before
    return Taken({**fields, **_of_run(run)}, origin_s, samples, blocks, angles, done, segments, run.plan.pulse_rate_hz)


def _emptied(queue: Any) -> list[NDArray[Any]]:
    found = []
    while queue:
        found.append(queue.popleft())
    return found


def _of_run(run: TestRun) -> dict[str, Any]:
    return {
        "test_id": run.plan.test_id,
        "segment": run.segment(),
        "elapsed_s": run.elapsed_s(),
        "duration_s": run.score.longest_s,
        "dropped_pulses": run.gate.dropped,
        "sent_pulses": run.sent,
        "charge_uc": run.gate.charge_uc,
        "torque_time_nms": float(np.nan_to_num(run.torque_time_nms)),
        "laid": run.score.decided,
        "boundary_s": run.score.decided / run.plan.pulse_rate_hz,
        "ended_by": run.ended_by,
        "pauses": run.pauses.all if run.pauses else [],
    }


def live_event(taken: Taken) -> LiveEvent:
    """The newest torque as minimum and maximum of bins of 10 ms, and the pulses."""
    found, rate_hz = np.concatenate(taken.blocks), taken.pulse_rate_hz
    bins = np.floor((found["host_time_s"] - taken.origin_s) / BIN_S)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(bins) > 0) + 1])
    return LiveEvent(
        **taken.fields,
        time_s=np.round(bins[starts] * BIN_S, 4).tolist(),
        torque_min_nm=_finite(np.fmin.reduceat(found["torque_nm"], starts)),
        torque_max_nm=_finite(np.fmax.reduceat(found["torque_nm"], starts)),
        pulse_time_s=[pulse.index / rate_hz for pulse in taken.done],
        pulse_width_us=[pulse.pulse_width_us for pulse in taken.done],
        laid_segments=[
            LaidSegment(name=name, start_s=start / rate_hz, end_s=end / rate_hz, by=by)
            for name, start, end, by in taken.segments
        ],
        samples=_samples(found, taken.origin_s) if taken.samples else None,
        outcomes=_outcomes(taken.done, taken.origin_s) if taken.samples else None,
        angle=_rows(taken.angles, taken.origin_s) if taken.samples and taken.angles is not None else None,
    )


def lines(taken: Taken) -> tuple[bytes, bytes]:
    """The event as JSON, one line each: with every sample if they are wanted, and without."""
    event = live_event(taken)
    full = to_line(event)
    if not taken.samples:
        return full, full
    return full, to_line(event.model_copy(update={"samples": None, "angle": None, "outcomes": None}))


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Make the lines of what is taken, until the end of input."""
    while True:
        try:
            taken = pickle.load(requests)
        except EOFError:
            return
        try:
            replies.writelines(lines(taken))
        except Exception:  # this one is lost, the next may do
            log.exception("a live event could not be made")
            replies.writelines((b"\n", b"\n"))
        replies.flush()


def _samples(found: NDArray[Any], origin_s: float) -> TorqueSamples:
    torque_nm = found["torque_nm"].round(6).tolist()
    return TorqueSamples(
        host_time_s=(found["host_time_s"] - origin_s).round(6).tolist(),
        counter=found["counter"].tolist(),
        torque_nm=[value if math.isfinite(value) else None for value in torque_nm],
        sync=found["sync"].tolist(),
    )


def _outcomes(done: list[Done], origin_s: float) -> PulseOutcomes:
    def times(name: str) -> list[float | None]:
        return [finite(round(getattr(pulse, name) - origin_s, 6)) for pulse in done]

    return PulseOutcomes(
        index=[pulse.index for pulse in done],
        pulse_width_us=[pulse.pulse_width_us for pulse in done],
        written_time_s=times("written_s"),
        acknowledged_time_s=times("acknowledged_s"),
        status=[int(pulse.status) for pulse in done],
    )


def _rows(angles: list[NDArray[Any]], origin_s: float) -> list[list[float | None]]:
    """Every angle since the last event."""
    rows: list[list[float | None]] = []
    for block in angles:
        moved = (block - [origin_s, 0.0, 0.0]).round(6).tolist()
        rows += [[row[0], finite(row[1]), finite(row[2])] for row in moved]
    return rows


def finite(value: float | None) -> float | None:
    """JSON has no NaN and no infinity: None."""
    return value if value is not None and math.isfinite(value) else None


def _finite(values: np.ndarray) -> list[float]:
    """JSON has no NaN: a bin without a number is set to zero; the fault is reported elsewhere."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0).round(5).tolist()
