"""What a model says a list of pulse widths would give, and which widths a torque needs. Run in a worker."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.workers.json_values import clean

Progress = Callable[[float, str], None]


def forecast(
    progress: Progress,
    model_json: str,
    pulse_width_us: list[float],
    pulse_rate_hz: float = 40.0,
    angle_rad: list[float] | None = None,
) -> dict[str, Any]:
    """Mean torque that the pulses give in each pulse's period, N·m, effects included, after one second of rest.

    `angle_rad`: of the joint in each pulse's period, where it moves.
    """
    from stimrig.identify.simulation.pulses import Motion, above_rest

    progress(0.1, "predicting")
    model = identify.Model.from_json(model_json)
    motion = None if angle_rad is None else Motion.of(np.asarray(angle_rad, float), pulse_rate_hz)
    torque = above_rest(model, np.asarray(pulse_width_us, float), pulse_rate_hz, motion)
    return {"torque_nm": torque.round(6).tolist()}


def invert(
    progress: Progress,
    model_json: str,
    reference_torque_nm: list[float] | None = None,
    time_s: list[float] | None = None,
    angle_rad: list[float] | None = None,
    table: str | None = None,
    pulse_rate_hz: float | None = None,
    largest_us: float | None = None,
    rise_us: float | None = None,
    whole: bool = True,
) -> dict[str, Any]:
    """The pulse widths whose predicted torque follows a reference best, and where it cannot be reached and why.

    The reference comes as numbers, or as the text of a CSV file (`table`).
    """
    from stimrig.identify.inversion import Reference
    from stimrig.identify.inversion import invert as widths_for
    from stimrig.identify.inversion.table import read_reference

    progress(0.1, "inverting")
    model = identify.Model.from_json(model_json)
    rate_hz = pulse_rate_hz or model.pulse_rate_hz
    if table is not None:
        reference = read_reference(table.encode(), "the upload", rate_hz)
    else:
        reference = Reference.of(reference_torque_nm, time_s, angle_rad=angle_rad, pulse_rate_hz=rate_hz)
    found = widths_for(model, reference, largest_us=largest_us, rise_us=rise_us, whole=whole)
    return clean(found.to_dict())
