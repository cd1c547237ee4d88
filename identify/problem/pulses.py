"""Free-run torque of a list of pulses, from rest, for planning a trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stimrig.identify.errors import BadModel
from stimrig.identify.problem.joint_surface import Surfaces
from stimrig.identify.problem.predict import predict
from stimrig.identify.records.joint_motion import JointMotion
from stimrig.identify.records.record import Record

if TYPE_CHECKING:
    from stimrig.identify.model import Model

REST_S = 1.0
SAMPLES_A_PULSE = 8


def motion_of(angle_rad: np.ndarray, pulse_rate_hz: float) -> JointMotion:
    """Motion of the joint by its mean angle in each pulse's period, as the sensor gives it, smoothed both ways."""
    return JointMotion.of(np.arange(len(angle_rad)) / pulse_rate_hz, np.asarray(angle_rad, float))


def above_rest(
    model: Model, pulse_width_us: np.ndarray, pulse_rate_hz: float, angle_rad: np.ndarray | None = None
) -> np.ndarray:
    """Mean torque in each pulse's period, N·m, after one second of rest, effects included; shape (K,).

    What the same model gives without any pulse is taken off: voluntary effort, tremor, hum and drift of the day of the
    test are no answer to a stimulus, and won't be there again. Of a joint that moves (`angle_rad`, as `motion_of` takes
    it) its passive torque stays: only what there is at rest at the first angle is taken off, as by the rest before a
    trial.

    Raises BadModel: as `predict`; the model depends on the joint, and nothing says where that is.
    """
    rest = round(REST_S * pulse_rate_hz)
    widths = np.r_[np.zeros(rest), np.asarray(pulse_width_us, float)]
    time_s = np.arange(widths.size * SAMPLES_A_PULSE) / (SAMPLES_A_PULSE * pulse_rate_hz)
    if angle_rad is None and Surfaces.of(model.effects) is not None:
        fix = "Give the angle at each pulse."
        raise BadModel("the model depends on the angle of the joint", place="angle_rad", fix=fix)

    def torque_of(widths_us: np.ndarray, angle: np.ndarray | None) -> np.ndarray:
        sampled_us, nothing = np.repeat(widths_us, SAMPLES_A_PULSE), np.zeros(time_s.size)
        record = Record.from_arrays(time_s, sampled_us, nothing, angle_rad=angle, pulse_rate_hz=pulse_rate_hz)
        return predict(model, record).reshape(-1, SAMPLES_A_PULSE).mean(axis=1)[rest:]

    moving = still = None
    if angle_rad is not None:
        angle = motion_of(angle_rad, pulse_rate_hz).angle_rad
        at = (np.arange(angle.size * SAMPLES_A_PULSE) + 0.5) / SAMPLES_A_PULSE
        moving = np.interp(at, np.arange(angle.size) + 0.5, angle)
        moving = np.r_[np.full(time_s.size - moving.size, moving[0]), moving]
        still = np.full(time_s.size, angle[0])
    return torque_of(widths, moving) - torque_of(np.zeros(widths.size), still)
