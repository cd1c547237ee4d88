"""The angle datasets of a recording, out of a journal's blocks; there are none where the rig had no angle sensor."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import align_angle, angle_velocity
from stimrig.rig.align import counted_rate_hz
from stimrig.rig.align_angle import Reference
from stimrig.rig.journal import JournalContents, Kind
from stimrig.rig.signals import ANGLE_SAMPLE, TRUSTED

LIKELY_RATE_HZ = 200.0
"""Assumed if the header is lost, and there are too few samples to measure it."""
LARGEST_RAD = 2 * np.pi
"""No joint turns farther, however its sensor is mounted."""


def of_journal(
    contents: JournalContents, header: dict[str, Any], torque: Reference, end_s: float
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Datasets by path and the attributes of their group; both empty without a sensor.

    Parameters
    ----------
    header
        The journal's; its `angle` is missing without a sensor, and where both copies of the header are lost.
    torque
        The test's torque samples, aligned.
    end_s
        End of the recording on the test's clock, s.
    """
    blocks = [np.frombuffer(payload, ANGLE_SAMPLE) for kind, payload in contents.blocks if kind == Kind.ANGLE]
    told = header.get("angle") or {}
    if not blocks and not told:
        return {}, {}
    samples = np.concatenate(blocks) if blocks else np.empty(0, ANGLE_SAMPLE)
    rate_hz = float(told.get("sample_rate_hz") or (len(samples) > 1 and counted_rate_hz(samples)) or LIKELY_RATE_HZ)
    time_s, alignment = align_angle.beside(
        samples, rate_hz, torque, bool(told.get("of_the_cell")), bool(told.get("one_bus"))
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
        "angle/velocity_rad_s": angle_velocity.centred(chosen["angle_rad"], number, measured_hz),
        "angle/raw": chosen["raw"],
        "angle/counter": chosen["counter"].astype(np.int64),
        "angle/host_time_s": chosen["host_time_s"] - torque.t0_s,
        "angle/gaps": np.column_stack([after, steps[after - 1] - 1]).astype(np.int64).reshape(-1, 2),
    }
    return {path: np.ascontiguousarray(column) for path, column in columns.items()}, {
        "sample_rate_hz": rate_hz,
        "sample_rate_measured_hz": measured_hz,
        **asdict(alignment),
        "velocity_method": angle_velocity.METHOD,
        "velocity_delay_s": 0.0,
        "velocity_window_s": angle_velocity.WINDOW_S,
        "calibration": json.dumps(told.get("calibration")),
    }


def _believable(samples: NDArray[Any]) -> NDArray[np.bool_]:
    """Which samples are the angle of a joint: others would spoil a test that did not need the sensor."""
    return (np.abs(samples["angle_rad"]) <= LARGEST_RAD) & np.isin(samples["fault"], TRUSTED)


def _numbers(samples: NDArray[Any], time_s: NDArray[np.float64], rate_hz: float) -> NDArray[np.int64]:
    """Number of each sample: its counter, else by its time."""
    counter = samples["counter"].astype(np.int64)
    if not len(counter) or np.all(counter >= 0):
        return counter
    steps = np.maximum(1, np.round(np.diff(time_s, prepend=time_s[:1]) * rate_hz)).astype(np.int64)
    return np.cumsum(steps)
