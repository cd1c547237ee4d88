"""Free-run torque of a list of pulses, from rest, for planning a trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

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


@dataclass(frozen=True)
class Motion:
    """Movement of the joint during a trial."""

    angle_rad: np.ndarray  # mean in each pulse's period, rad, shape (K,)
    velocity_rad_s: np.ndarray  # the same, rad/s

    @classmethod
    def of(cls, angle_rad: np.ndarray, pulse_rate_hz: float) -> Motion:
        """From the angles alone, as the sensor gives them (late if it is late), smoothed in both directions."""
        angle = np.asarray(angle_rad, float)
        motion = JointMotion.of(np.arange(angle.size) / pulse_rate_hz, angle)
        return cls(motion.angle_rad, motion.velocity_rad_s)

    @classmethod
    def still(cls, angle_rad: float, size: int) -> Motion:
        """A joint that is held at one angle."""
        return cls(np.full(size, angle_rad), np.zeros(size))

    def columns(self, rest: int) -> dict[str, np.ndarray]:
        """Angle and velocity at the samples of a record that begins with `rest` periods at the first angle, at rest."""
        middle = np.arange(self.angle_rad.size) + 0.5
        at = (np.arange(self.angle_rad.size * SAMPLES_A_PULSE) + 0.5) / SAMPLES_A_PULSE
        still = np.zeros(rest * SAMPLES_A_PULSE)
        angle = np.interp(at, middle, self.angle_rad)
        return {
            "angle_rad": np.r_[still + angle[0], angle],
            "velocity_rad_s": np.r_[still, np.interp(at, middle, self.velocity_rad_s)],
        }


def above_rest(
    model: Model, pulse_width_us: np.ndarray, pulse_rate_hz: float, motion: Motion | None = None
) -> np.ndarray:
    """Mean torque in each pulse's period, N·m, after one second of rest, effects included; shape (K,).

    What the same model gives without any pulse is taken off: voluntary effort, tremor, hum and drift of the day of the
    test are no answer to a stimulus, and won't be there again. Of a joint that moves (`motion`) its passive torque
    stays: only what there is at rest at the movement's first angle is taken off, as by the rest before a trial.

    Raises BadModel: as `predict`; the model depends on the joint, and nothing says where that is.
    """
    rest = round(REST_S * pulse_rate_hz)
    widths = np.asarray(pulse_width_us, float)
    if motion is None and Surfaces.of(model.effects) is not None:
        fix = "Give the angle at each pulse."
        raise BadModel("the model depends on the angle of the joint", place="angle_rad", fix=fix)

    def torque_of(widths_us: np.ndarray, moved: Motion | None) -> np.ndarray:
        sample_widths_us = np.repeat(np.r_[np.zeros(rest), widths_us], SAMPLES_A_PULSE)
        time_s = np.arange(sample_widths_us.size) / (SAMPLES_A_PULSE * pulse_rate_hz)
        columns: dict[str, Any] = {} if moved is None else moved.columns(rest)
        record = Record.from_arrays(
            time_s, sample_widths_us, np.zeros(sample_widths_us.size), pulse_rate_hz=pulse_rate_hz, **columns
        )
        return predict(model, record).reshape(-1, SAMPLES_A_PULSE).mean(axis=1)[rest:]

    at_rest = None if motion is None else Motion.still(float(motion.angle_rad[0]), widths.size)
    return torque_of(widths, motion) - torque_of(np.zeros(widths.size), at_rest)
