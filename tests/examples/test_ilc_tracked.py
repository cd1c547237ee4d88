"""The controller with the filter in its loop, on simulated muscles that change or stay; no service between them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from examples import ilc_controller as ilc
from stimrig.identify.fitting import fit
from stimrig.identify.model import Model
from stimrig.identify.tracking import QUANTITIES, State, follow, model_for_next
from tests.harness.changing import Changing
from tests.harness.muscle import Patient
from tests.harness.patients import make_record

PEOPLE = {
    55001: Patient.with_rise(45.0, 120.0, gain=8.0, time_constant_s=0.25, damping=0.9),
    55002: Patient.with_rise(70.0, 90.0, gain=4.0, time_constant_s=0.16, damping=0.7),
    55003: Patient.with_rise(60.0, 150.0, gain=11.0, time_constant_s=0.35, damping=1.0),
}
TRIALS = 10
REST = 40
"""Pulse periods before and after a trial."""


class Loop:
    """Stands where the service stands: a trial is recorded, followed, and the moved model served."""

    wanted_nm: np.ndarray | None = None

    def __init__(self, model: Model, muscle: Changing, seed: int) -> None:
        self.model, self.muscle, self.rng = model, muscle, np.random.default_rng(seed)
        self.state: State | None = None
        self.trials = 0
        self.moved: list[float] = []

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rests = np.zeros(REST)
        self.record = self.muscle.play(np.r_[rests, widths_us, rests], self.trials, self.rng)
        self.trials += 1
        torque_nm = self.record.torque_nm.reshape(widths_us.size + 2 * REST, -1)
        return torque_nm[REST : REST + widths_us.size].mean(axis=1) - torque_nm[12:REST].mean(), widths_us

    def fetch_followed(self) -> dict[str, Any]:
        step = follow(self.model, self.state, self.record)
        if self.state is not None:
            bands = 1.96 * np.sqrt(np.diag(self.state.covariance)[: len(QUANTITIES)])
            self.moved.append(float(np.max(np.abs(step.coming.mean - self.state.mean)[: len(QUANTITIES)] / bands)))
        self.state = step.coming
        tracking = step.to_dict() | {"moved": list(QUANTITIES)}
        return model_for_next(self.model, step).to_dict() | {"tracking": tracking}


@pytest.fixture(scope="module")
def models() -> dict[int, Model]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return {seed: fit(make_record(one, np.random.default_rng(seed))[0]) for seed, one in PEOPLE.items()}


def errors(model: Model, muscle: Changing, seed: int, tracked: bool = True) -> tuple[np.ndarray, list[float]]:
    document, loop = model.to_dict(), Loop(model, muscle, seed)
    reference = ilc.Reference.reach(0.4 * float(document["recruitment"]["inverse"]["torque_nm"][-1]))
    done = ilc.learn(loop, document, reference, "norm-optimal", TRIALS, tracked=tracked)  # pyright: ignore
    return np.array([trial.error_percent for trial in done]), loop.moved


@pytest.fixture(scope="module")
def still(models: dict[int, Model]) -> dict[int, tuple[np.ndarray, list[float]]]:
    """Followed, where nothing changes."""
    return {seed: errors(models[seed], Changing(patient), seed) for seed, patient in PEOPLE.items()}


def test_where_nothing_changes_following_costs_nothing_and_moves_nothing(
    models: dict[int, Model], still: dict[int, tuple[np.ndarray, list[float]]]
) -> None:
    without = [errors(models[seed], Changing(patient), seed, tracked=False)[0] for seed, patient in PEOPLE.items()]
    last = [np.mean([found[-3:] for found in runs]) for runs in ([found for found, _ in still.values()], without)]
    moved = [far for _, each in still.values() for far in each]
    assert last[0] < 1.05 * last[1], last
    assert len(moved) == 3 * (TRIALS - 1) and max(moved) < 1.0


@pytest.mark.parametrize(
    ("change", "most"),
    [
        ({"gain": lambda n: 1 - 0.04 * n}, 1.3),
        ({"gain": lambda n: 1 + 0.25 * (1 - np.exp(-n / 3))}, 1.5),
        ({"shift_us": lambda n: 1.5 * n}, 1.5),
        ({"time_scale": lambda n: 1 + 0.03 * n}, 1.5),
    ],
    ids=["fatigue of 40 %", "potentiation", "threshold drift", "slower"],
)
def test_a_muscle_that_changes_is_followed(
    models: dict[int, Model],
    still: dict[int, tuple[np.ndarray, list[float]]],
    change: dict[str, Callable[[float], float]],
    most: float,
) -> None:
    ratios = []
    for seed, patient in PEOPLE.items():
        found, _ = errors(models[seed], Changing(patient, **change), seed)
        ratios.append(np.mean(found[-2:]) / np.mean(still[seed][0][-2:]))
    assert np.median(ratios) <= most, ratios
    assert max(ratios) <= 1.5 * most, ratios
