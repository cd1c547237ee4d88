"""Muscle fatigue: the gain falls during use and recovers at rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from identify.effects.base import Effect, Form, Parameter, Scene
from identify.effects.kernels import adapt

_DEPTH = Parameter("depth", "1", 0.0, 0.95, 0.0, (0.3, 0.6), about="largest share of torque that is lost")
_ONSET = Parameter("onset_s", "s", 3.0, 250.0, 30.0, (15.0, 50.0), "log", about="time constant under full stimulation")
_RECOVERY = Parameter("recovery_s", "s", 4.0, 400.0, 50.0, (40.0, 90.0), "log", about="time constant at rest")


def _level(drive: np.ndarray, scene: Scene) -> np.ndarray:
    return np.minimum(np.abs(drive) / scene.scale_nm, 1.0)


def _fitness(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    x = adapt(_level(drive, scene), p["onset_s"][:, 0], p["recovery_s"][:, 0], False, scene.step_s, scene.rest_s)
    return drive * (1.0 - p["depth"] * x)


def _compartments(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    x = adapt(_level(drive, scene), p["onset_s"][:, 0], p["recovery_s"][:, 0], True, scene.step_s, scene.rest_s)
    return drive * (1.0 - p["depth"] * x)


def _by_pulses(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    on = np.broadcast_to(scene.on, drive.shape)
    x = adapt(on, p["onset_s"][:, 0], p["recovery_s"][:, 0], False, scene.step_s, scene.rest_s)
    return drive * (1.0 - p["depth"] * x)


EFFECT = Effect(
    id="fatigue",
    name="Fatigue",
    forms=(
        Form(
            "fitness",
            "gain",
            "w = μ f(u); μ = 1 - depth·x; x' = a(1 - x)/onset - (1 - a) x/recovery; a = |f|/f_max",
            (_DEPTH, _ONSET, _RECOVERY),
            _fitness,
            batched=True,
            source="Riener, Quintern, Schmidt 1996, muscle fitness",
        ),
        Form(
            "compartments",
            "gain",
            "w = (1 - depth·x) f(u); x' = a(1 - x)/onset - x/recovery",
            (_DEPTH, _ONSET, _RECOVERY),
            _compartments,
            batched=True,
            source="Ding et al. 2003 (A falls with force, recovers with one time constant); Xia, Frey-Law 2008",
        ),
        Form(
            "by_pulses",
            "gain",
            "w = μ f(u); μ = 1 - depth·x; x' = a(1 - x)/onset - (1 - a) x/recovery; a = 1 under pulses of any width, "
            "else 0",
            (_DEPTH, _ONSET, _RECOVERY),
            _by_pulses,
            batched=True,
        ),
    ),
    signature="Torque above the model early in the stimulation and below it late; after a rest it is higher again.",
    resembles=("threshold_drift", "potentiation", "baseline_drift"),
    separated_by="The ramp repeated after stimulation, and once more after a rest.",
    plain="The muscle tires: the longer it has worked, the less torque the same pulse gives. It recovers at rest. "
    "After a stroke, muscles tire sooner. Late in a session the muscle needs more charge, or longer rests.",
    source="Riener et al. 1996; Ding et al. 2003",
)
