"""Aligns the angle sensor's clock with the test's clock, through the torque.

The torque's times are aligned with the pulses already (`rig.align`). Where the angle stands in the load cell's frames,
its times are those of these frames. Where one interface stamps the frames of both, its stamps are one clock for both.
Over one adapter without such stamps, frames come in the order in which they were sent: an angle was sent between the
torques before and after it, however late all of them were read. Of two adapters only the times of arrival are known: a
sample can come late, never early.

A joint's velocity at once is the slope of a line through the last 50 ms of its angles, so it is 25 ms late. In a
recording it is centred: the slope of a parabola through 60 ms around each sample (Savitzky and Golay), so it is not
late; at the ends of a stretch the parabola is one-sided.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import align
from stimrig.rig.align import Alignment, Array, Line, Method, counted_rate_hz, describe
from stimrig.rig.journal import JournalContents, Kind
from stimrig.rig.signals import ANGLE_SAMPLE, TRUSTED

Numbers = NDArray[np.int64]

LIVE_WINDOW_S = 0.05
MIN_SAMPLES = 3
"""Samples for a slope at once."""
WINDOW_S = 0.06
METHOD = "local quadratic over 60 ms, centred"
LONGEST_GAP_S = 0.05
"""Over a shorter gap the angle is interpolated. A longer one ends a stretch."""


class LiveSlope:
    """Slopes of the newest samples, by nothing that comes after them."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._width = max(MIN_SAMPLES - 1, round(LIVE_WINDOW_S * rate_hz))
        self.forget()

    def forget(self) -> None:
        """Begin again, without the samples until now."""
        self._number, self._value = np.empty(0, np.int64), np.empty(0)

    def add(self, number: Numbers, value: Array) -> Array:
        """Slope per second at each of these samples, shape (n,); NaN where too few came before it.

        `number`: of the samples, rising, shape (n,); gaps may be in it. `value`: shape (n,).
        """
        numbers, values = np.concatenate([self._number, number]), np.concatenate([self._value, value])
        behind = number[:, None] - numbers[None, :]
        inside = (behind >= 0) & (behind <= self._width)
        count = inside.sum(axis=1)
        x = -behind / self._rate_hz
        x = np.where(inside, x - ((x * inside).sum(axis=1) / count)[:, None], 0.0)
        spread = (x * x).sum(axis=1)
        rise = (x * np.where(inside, values[None, :], 0.0)).sum(axis=1)
        recent = numbers >= numbers[-1] - self._width
        self._number, self._value = numbers[recent], values[recent]
        return np.divide(rise, spread, out=np.full(len(number), np.nan), where=count >= MIN_SAMPLES)


def centred(angle_rad: Array, number: Numbers, rate_hz: float) -> Array:
    """Velocity at each sample, rad/s, shape (n,).

    `angle_rad`: finite, shape (n,); `number`: of the samples, rising, shape (n,); `rate_hz`: samples per second.
    """
    if not len(number):
        return np.empty(0)
    ends = np.flatnonzero(np.diff(number) > max(1.0, LONGEST_GAP_S * rate_hz)) + 1
    centred = np.zeros(len(number))
    for part in np.split(np.arange(len(number)), ends):
        at = number[part] - number[part[0]]
        even_rad = np.interp(np.arange(at[-1] + 1), at, angle_rad[part])
        centred[part] = _slopes(even_rad, max(1, round(0.5 * WINDOW_S * rate_hz)))[at] * rate_hz
    return centred


def _slopes(value: Array, half: int) -> Array:
    """Slope per sample at each one of an even stretch, by a parabola through `half` neighbours on either side."""
    width = 2 * half + 1
    if len(value) < width:
        return _parabola_slope(value, np.arange(len(value)))
    x = np.arange(-half, half + 1)
    middle = np.convolve(value, -x / np.sum(x * x), "valid")  # a parabola's slope in its centre is that of a line
    before, after = np.arange(half), np.arange(half + 1, width)
    return np.concatenate([_parabola_slope(value[:width], before), middle, _parabola_slope(value[-width:], after)])


def _parabola_slope(value: Array, at: Numbers) -> Array:
    """Slope per sample of the parabola through these values, at some of them."""
    if len(value) < 2:
        return np.zeros(len(at))
    centre = 0.5 * (len(value) - 1)
    fitted = np.polynomial.polynomial.polyfit(np.arange(len(value)) - centre, value, min(2, len(value) - 1))
    return np.asarray(
        np.polynomial.polynomial.polyval(at - centre, np.polynomial.polynomial.polyder(fitted)), np.float64
    )


ONE_CLOCK_S = 5e-4
"""Stamps that give other times than the order of the frames do are not of one clock: a device stamps itself."""
LONGEST_PERIOD_S = 0.002
"""The order of frames tells enough only where the cell's follow one another at least so soon."""
LEAST_ORDERED = 20


@dataclass(frozen=True, slots=True)
class Reference:
    """The torque samples as they came, their aligned times and the error of these."""

    samples: NDArray[Any]  # dtype `SAMPLE`, shape (N,)
    time_s: Array  # test's clock, shape (N,)
    t0_s: float  # start of the test's clock on the rig's, s
    error_ms: float  # of `time_s`


def align_angle(
    samples: NDArray[Any], rate_hz: float, torque: Reference, of_the_cell: bool, one_bus: bool
) -> tuple[Array, Alignment]:
    """Time of each angle sample on the test's clock.

    `samples`: dtype `ANGLE_SAMPLE`, shape (N,), their counters unwrapped; `rate_hz`: nominal; `torque`: of the same
    test. `of_the_cell`, `one_bus`: whether the angle stands in the cell's frames, and whether its frames come over the
    cell's adapter.
    """
    host_s = samples["host_time_s"] - torque.t0_s
    if len(samples) < 2:
        return host_s, Alignment("regression", float("nan"), 0.0, 0.0)
    sensor_s = align.cell_time(samples["counter"].astype(np.int64), samples["stamp_s"], rate_hz)
    if of_the_cell and (same := _match_frames(samples, torque)) is not None:
        which, known_s = same
        line = align.robust_line(sensor_s[which], known_s)
        off_s = np.interp(sensor_s, sensor_s[which], known_s - line.at(sensor_s[which]))
        time_s = line.at(sensor_s) + off_s
        time_s[which] = known_s
        return time_s, describe("cell", torque.error_ms * 1e-3, host_s, time_s, line.rate)
    estimate, error_s, method = (one_bus and _align_order(samples, sensor_s, torque)) or _align_arrival(
        host_s, sensor_s
    )
    if one_bus and _stamped(samples) and _stamped(torque.samples):
        line, stamps_error_s = _align_stamps(samples["stamp_s"], sensor_s, torque)
        ends_s = sensor_s[[0, -1]]
        if np.max(np.abs(line.at(ends_s) - estimate.at(ends_s))) <= max(ONE_CLOCK_S, error_s):
            estimate, error_s, method = line, stamps_error_s, "stamps"
    time_s = estimate.at(sensor_s)
    error_s = float(np.hypot(torque.error_ms * 1e-3, error_s))
    return time_s, describe(method, error_s, host_s, time_s, estimate.rate)


def _match_frames(samples: NDArray[Any], torque: Reference) -> tuple[NDArray[np.bool_], Array] | None:
    """Find the samples that came in the frame of a torque sample, and its time; None: fewer than two did.

    Both were read at once, so they have the same time of arrival. A frame with several torques was sent with the last.
    """
    arrived_s = torque.samples["host_time_s"]
    at = np.searchsorted(arrived_s, samples["host_time_s"], side="right") - 1
    same = (at >= 0) & (arrived_s[np.maximum(at, 0)] == samples["host_time_s"]) if len(arrived_s) else at > 0
    return (same, torque.time_s[at[same]]) if np.sum(same) > 1 else None


def _stamped(samples: NDArray[Any]) -> bool:
    stamp_s = samples["stamp_s"]
    return len(samples) > 1 and bool(np.all(np.isfinite(stamp_s))) and bool(np.all(np.diff(stamp_s) >= 0))


def _align_stamps(stamp_s: Array, sensor_s: Array, torque: Reference) -> tuple[Line, float]:
    """Through the interface's stamps of both: a line from the sensor's clock to the stamps, one on to the test's."""
    on = align.robust_line(torque.samples["stamp_s"], torque.time_s)
    of = align.robust_line(sensor_s, stamp_s)
    end_s = float(on.at(of.at(np.array([of.centre_s])))[0])
    line = Line(end_s - of.centre_s, of.rate * on.rate, of.centre_s, 0.0)
    return line, float(np.hypot(on.error_s, of.error_s))


def _align_order(samples: NDArray[Any], sensor_s: Array, torque: Reference) -> tuple[Line, float, Method] | None:
    """Through the torques that came right before and after each angle; None: too few did, or too far apart.

    A sensor may keep step with the cell, so the place between the two does not average out.
    """
    arrived_s = torque.samples["host_time_s"]
    last = np.flatnonzero(np.diff(arrived_s, append=np.inf) > 0)  # of each frame: it was sent with its last torque
    if len(last) < 2:
        return None
    arrived_s, sent_s = arrived_s[last], torque.time_s[last]
    period_s = float(np.median(np.diff(sent_s)))
    after = np.searchsorted(arrived_s, samples["host_time_s"])
    between = np.flatnonzero((after > 0) & (after < len(sent_s)))
    before_s, after_s = sent_s[after[between] - 1], sent_s[after[between]]
    near = after_s - before_s < 1.5 * period_s
    if np.sum(near) < LEAST_ORDERED or not (period_s <= LONGEST_PERIOD_S):
        return None
    line = _fitted(sensor_s[between[near]], 0.5 * (before_s + after_s)[near], period_s)
    return line, float(np.hypot(line.error_s, period_s / np.sqrt(12))), "order"


def _fitted(sensor_s: Array, time_s: Array, period_s: float) -> Line:
    """Least squares through points that stand on a grid of times, on which a median of slopes would see no drift."""
    line = align.robust_line(sensor_s, time_s)
    for _ in range(2):  # the first line may be off by a drift of some periods over a test
        residual_s = time_s - line.at(sensor_s)
        inliers = np.abs(residual_s) <= max(3 * period_s, 4 * float(np.median(np.abs(residual_s))))
        x_s, y_s = sensor_s[inliers] - line.centre_s, (time_s - sensor_s)[inliers]
        slope, offset_s = np.polynomial.polynomial.polyfit(x_s, y_s, 1)[::-1]
        line = Line(
            float(offset_s),
            1 + float(slope),
            line.centre_s,
            float(np.std(residual_s[inliers]) / np.sqrt(inliers.sum())),
        )
    return line


def _align_arrival(host_s: Array, sensor_s: Array) -> tuple[Line, float, Method]:
    """Below the times of arrival, as `stimrig.rig.align` does without a sync line."""
    points = align.earliest(sensor_s, host_s)
    line = align.line_below(*points)
    error_s = align.misfit(line, *points)
    return line, float(np.hypot(line.error_s, error_s)), "regression"


LIKELY_RATE_HZ = 200.0
"""Assumed if the header is lost, and there are too few samples to measure it."""
LARGEST_RAD = 2 * np.pi
"""No joint turns farther, however its sensor is mounted."""


def read_angles(
    contents: JournalContents, header: dict[str, Any], torque: Reference, end_s: float
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Datasets by path and the attributes of their group; both empty without a sensor.

    `header`: the journal's; its `angle` is missing without a sensor, and where both copies of the header are lost.
    `torque`: the test's torque samples, aligned. `end_s`: end of the recording on the test's clock, s.
    """
    blocks = [np.frombuffer(payload, ANGLE_SAMPLE) for kind, payload in contents.blocks if kind == Kind.ANGLE]
    described = header.get("angle") or {}
    if not blocks and not described:
        return {}, {}
    samples = np.concatenate(blocks) if blocks else np.empty(0, ANGLE_SAMPLE)
    rate_hz = float(
        described.get("sample_rate_hz") or (len(samples) > 1 and counted_rate_hz(samples)) or LIKELY_RATE_HZ
    )
    time_s, alignment = align_angle(
        samples, rate_hz, torque, bool(described.get("of_the_cell")), bool(described.get("one_bus"))
    )
    number = _numbers(samples, time_s, rate_hz)
    inside = (time_s >= 0) & (time_s < end_s) & _believable(samples)
    # a sensor that started again may overlap itself
    inside &= time_s > np.maximum.accumulate(np.concatenate([[-np.inf], time_s]))[:-1]
    chosen, number = samples[inside], number[inside]
    steps = np.diff(number)
    after = np.flatnonzero(steps > 1) + 1
    measured_hz = rate_hz / (1 + alignment.rate_ppm * 1e-6)
    columns: dict[str, NDArray[Any]] = {
        "angle/time_s": time_s[inside],
        "angle/angle_rad": chosen["angle_rad"],
        "angle/velocity_rad_s": centred(chosen["angle_rad"], number, measured_hz),
        "angle/raw": chosen["raw"],
        "angle/counter": chosen["counter"].astype(np.int64),
        "angle/host_time_s": chosen["host_time_s"] - torque.t0_s,
        "angle/gaps": np.column_stack([after, steps[after - 1] - 1]).astype(np.int64).reshape(-1, 2),
    }
    return {path: np.ascontiguousarray(column) for path, column in columns.items()}, {
        "sample_rate_hz": rate_hz,
        "sample_rate_measured_hz": measured_hz,
        **asdict(alignment),
        "velocity_method": METHOD,
        "velocity_delay_s": 0.0,
        "velocity_window_s": WINDOW_S,
        "calibration": json.dumps(described.get("calibration")),
    }


def _believable(samples: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask the samples that can be the angle of a joint: others would spoil a test that did not need the sensor."""
    return (np.abs(samples["angle_rad"]) <= LARGEST_RAD) & np.isin(samples["fault"], TRUSTED)


def _numbers(samples: NDArray[Any], time_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.int64]:
    """Number of each sample: its counter, else by its time."""
    counter = samples["counter"].astype(np.int64)
    if not len(counter) or np.all(counter >= 0):
        return counter
    steps = np.maximum(1, np.round(np.diff(time_s, prepend=time_s[:1]) * rate_hz)).astype(np.int64)
    return np.cumsum(steps)
