"""Aligns the angle sensor's clock with the test's clock, through the torque.

The torque's times are aligned with the pulses already (`rig.align`). Where the angle stands in the load cell's frames,
its times are those of these frames. Where one interface stamps the frames of both, its stamps are one clock for both.
Elsewhere each sample came late by some delay, and the least delays of both are taken for equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rig import align
from rig.align import Array, Line

Method = Literal["cell", "stamps", "regression"]


@dataclass(frozen=True, slots=True)
class AngleAlignment:
    """As `align.Alignment`; `error_ms` contains that of the torque, through which it was obtained."""

    method: Method
    error_ms: float
    delay_ms: float
    rate_ppm: float


@dataclass(frozen=True, slots=True)
class Reference:
    """The torque samples as they came, their aligned times and the error of these.

    Attributes
    ----------
    samples
        Dtype `SAMPLE`, shape (N,).
    time_s
        Test's clock, shape (N,).
    t0_s
        Start of the test's clock on the rig's, s.
    error_ms
        Of `time_s`.
    """

    samples: NDArray[Any]
    time_s: Array
    t0_s: float
    error_ms: float


def beside(
    samples: NDArray[Any], rate_hz: float, torque: Reference, of_the_cell: bool, one_bus: bool
) -> tuple[Array, AngleAlignment]:
    """Time of each angle sample on the test's clock.

    Parameters
    ----------
    samples
        Dtype `ANGLE_SAMPLE`, shape (N,), their counters unwrapped.
    rate_hz
        Nominal.
    torque
        Of the same test.
    of_the_cell, one_bus
        Whether the angle stands in the cell's frames; whether its frames come over the cell's adapter.
    """
    host_s = samples["host_time_s"] - torque.t0_s
    if len(samples) < 2:
        return host_s, AngleAlignment("regression", float("nan"), 0.0, 0.0)
    sensor_s = align.cell_time(samples["counter"].astype(np.int64), samples["stamp_s"], rate_hz)
    if of_the_cell and (same := _of_same_frames(samples, torque)) is not None:
        which, known_s = same
        line = align.robust_line(sensor_s[which], known_s)
        off_s = np.interp(sensor_s, sensor_s[which], known_s - line.at(sensor_s[which]))
        time_s = line.at(sensor_s) + off_s
        time_s[which] = known_s
        return time_s, _told("cell", torque.error_ms, host_s, time_s, line.rate)
    stamped = one_bus and all(
        len(found) > 1 and bool(np.all(np.isfinite(found["stamp_s"]))) for found in (samples, torque.samples)
    )
    if stamped:
        found, error_s, method = _by_stamps(samples["stamp_s"], sensor_s, torque)
    else:
        found, error_s, method = _by_arrival(host_s, sensor_s, torque, one_bus)
    time_s = found.at(sensor_s)
    error_ms = float(np.hypot(torque.error_ms, error_s * 1e3))
    return time_s, _told(method, error_ms, host_s, time_s, found.rate)


def _told(method: Method, error_ms: float, host_s: Array, time_s: Array, rate: float) -> AngleAlignment:
    return AngleAlignment(method, error_ms, float(np.median(host_s - time_s)) * 1e3, (rate - 1) * 1e6)


def _of_same_frames(samples: NDArray[Any], torque: Reference) -> tuple[NDArray[np.bool_], Array] | None:
    """Which samples came in the frame of a torque sample, and its time; None: fewer than two did.

    Both were read at once, so they have the same time of arrival. A frame with several torques was sent with the last.
    """
    arrived_s = torque.samples["host_time_s"]
    at = np.searchsorted(arrived_s, samples["host_time_s"], side="right") - 1
    same = (at >= 0) & (arrived_s[np.maximum(at, 0)] == samples["host_time_s"]) if len(arrived_s) else at > 0
    return (same, torque.time_s[at[same]]) if np.sum(same) > 1 else None


def _by_stamps(stamp_s: Array, sensor_s: Array, torque: Reference) -> tuple[Line, float, Method]:
    """Through the interface's stamps of both: a line from the sensor's clock to the stamps, one on to the test's."""
    on = align.robust_line(torque.samples["stamp_s"], torque.time_s)
    of = align.robust_line(sensor_s, stamp_s)
    return _chained(of, on), float(np.hypot(on.error_s, of.error_s)), "stamps"


def _by_arrival(host_s: Array, sensor_s: Array, torque: Reference, one_bus: bool) -> tuple[Line, float, Method]:
    """Below the times of arrival of both; of two adapters the delays are not known to be equal."""
    of = align.lower_envelope(sensor_s, host_s)
    error_s = float(np.hypot(of.error_s, align.misfit(of, *align.earliest(sensor_s, host_s))))
    if not one_bus or len(torque.samples) < 2:
        return of, error_s, "regression"
    on = align.lower_envelope(torque.time_s, torque.samples["host_time_s"] - torque.t0_s)
    return _chained(of, _inverse(on)), float(np.hypot(error_s, on.error_s)), "regression"


def _inverse(line: Line) -> Line:
    """The line that leads back."""
    return Line(-line.offset_s, 1 / line.rate, line.offset_s + line.centre_s, line.error_s)


def _chained(first: Line, then: Line) -> Line:
    """The line that leads through both."""
    end_s = float(then.at(first.at(np.array([first.centre_s])))[0])
    return Line(end_s - first.centre_s, first.rate * then.rate, first.centre_s, 0.0)
