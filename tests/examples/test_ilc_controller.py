"""The learning controller: uses the client alone; learns on a muscle that is not its model; halts with the rig."""

from __future__ import annotations

import ast
import io
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from examples import ilc_controller as ilc
from tests.harness.muscle import Patient

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[2] / "examples"


def patient_of(period_s: float, damping: float, plateau_nm: float, middle_us: float) -> Patient:
    return Patient(plateau_nm, 1 / 22, float(np.exp(middle_us / 22)), period_s, damping)


def felt(patient: Patient, widths_us: np.ndarray) -> np.ndarray:
    """Mean torque of each pulse interval, N·m."""
    return patient.torque(widths_us, 2000.0).reshape(-1, 50).mean(axis=1)


def model_of(period_s: float, damping: float, plateau_nm: float, middle_us: float) -> dict[str, Any]:
    """MODEL.json as far as the controller reads it: the linear part as a recursion at 400 Hz."""
    widths = np.arange(0.0, 301.0, 2.0)
    levels = patient_of(period_s, damping, plateau_nm, middle_us).recruitment(widths)
    step = 1 / 400
    poles = np.roots([period_s**2, 2 * damping * period_s, 1.0])
    a = np.poly(np.exp(poles * step)).real
    back = np.linspace(0, levels[-1], 200)
    back_us = np.interp(back, levels, widths)
    return {
        "model_id": "M", "sample_rate_hz": 400.0, "effects": [],
        "linear": {"b": [0.0, float(a.sum())], "a": a.tolist(), "delay_samples": 0},
        "recruitment": {
            "pulse_width_us": widths.tolist(),
            "torque_nm": levels.tolist(),
            "inverse": {"torque_nm": back.tolist(), "pulse_width_us": back_us.tolist()},
        },
        "valid_for": {"pulse_width_us": [0.0, 300.0]},
    }  # fmt: skip


MODEL = (0.40, 0.65, 6.6, 148.0)
UNLIKE_THE_MODEL = patient_of(0.46, 0.68, 7.2, 152.0)


class Muscle:
    """Stands where the service stands: 10 % stronger, 15 % slower, threshold shifted, noisy; may drop pulses."""

    def __init__(self, drops: bool = False) -> None:
        self.rng, self.drops = np.random.default_rng(8), drops

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sent = widths_us.copy()
        assert np.all(np.diff(np.r_[0, widths_us]) <= 50) and np.all(widths_us == np.round(widths_us))
        if self.drops:
            sent[self.rng.integers(0, sent.size, 3)] = 0.0
        return felt(UNLIKE_THE_MODEL, sent) + 0.01 * self.rng.standard_normal(sent.size), sent


@pytest.mark.parametrize("name", ["ilc_controller", "ilc_moving_joint"])
def test_imports_nothing_of_ours_but_the_client(name: str) -> None:
    nodes = list(ast.walk(ast.parse((FOLDER / f"{name}.py").read_text("utf-8"))))
    names = {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    assert "stimrig" in names
    assert not {name for name in names if name.split(".")[0] in ("rig", "identify", "api", "hardware_sim")}
    assert {name for name in names if name.startswith("stimrig.")} <= {"stimrig.errors"}


@pytest.mark.parametrize(("law", "static"), [("norm-optimal", False), ("phase-lead", True)])
def test_error_falls_below_five_percent_in_five_trials(law: str, static: bool) -> None:
    """On a muscle unlike its model: below 5 % by the fifth trial, falling from the first until noise is reached."""
    reference = ilc.Reference.reach(4.0)
    trials = ilc.learn(Muscle(), model_of(*MODEL), reference, law, 10, static)
    errors = [trial.error_percent for trial in trials]
    assert errors[0] > 4, "else there was nothing to learn"
    assert min(errors[:5]) < 5, errors
    floor = 2.0
    assert all(later < before for before, later in pairwise(errors) if before > floor), errors
    assert errors[-1] < floor, errors


def test_dropped_pulses_are_not_learnt_from() -> None:
    reference = ilc.Reference.reach(4.0)
    trials = ilc.learn(Muscle(drops=True), model_of(*MODEL), reference, "norm-optimal", 6)
    assert all(trial.lost_pulses for trial in trials)
    clean, _ = Muscle().play(trials[-1].widths_us)
    assert 100 * np.sqrt(np.mean((clean - reference.torque_nm) ** 2)) / reference.rms_nm < 3


def test_trial_that_did_not_end_well_halts_the_controller() -> None:
    file = io.BytesIO()
    with h5py.File(file, "w") as recording:
        recording.attrs["outcome"], recording.attrs["reason"] = "fault", "the load cell fell silent"
    with pytest.raises(ilc.HaltedError, match="load cell fell silent"):
        ilc.measured(file.getvalue(), 400)


# ---- the model followed from trial to trial -------------------------------------------------------------------------


def levels(gain: float, shift_us: float, time_scale: float) -> dict[str, dict[str, float]]:
    """As the service tells them, without their bands."""
    values = {"gain": gain, "threshold_shift_us": shift_us, "time_scale": time_scale}
    return {name: {"value": value, "low": value, "high": value} for name, value in values.items()}


def moved(gain: float, shift_us: float, time_scale: float) -> tuple[float, float, float, float]:
    """A muscle's four figures (`patient_of`), moved by such levels."""
    period_s, damping, plateau_nm, middle_us = MODEL
    return period_s * time_scale, damping, plateau_nm * gain, middle_us + shift_us


def document_of(now: tuple[float, ...], coming: tuple[float, ...]) -> dict[str, Any]:
    """What the service sends, with the levels now and in the next trial."""
    told = {"now": levels(*now), "coming": levels(*coming), "moved": ["gain", "threshold_shift_us", "time_scale"]}
    return model_of(*moved(*coming)) | {"tracking": told}


class Tiring(Muscle):
    """Loses gain, its threshold rises and it slows from trial to trial; told of by a service that follows it well."""

    def __init__(self, falls: float = 0.05, rises_us: float = 1.5, slows: float = 0.03) -> None:
        super().__init__()
        self.step, self.trials = (1 - falls, rises_us, 1 + slows), 0

    def at(self, trial: int) -> tuple[float, float, float]:
        gain, shift_us, slow = self.step
        return gain**trial, shift_us * trial, slow**trial

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        torque_nm = felt(patient_of(*moved(*self.at(self.trials))), widths_us)
        self.trials += 1
        return torque_nm + 0.005 * self.rng.standard_normal(widths_us.size), widths_us

    def fetch_followed(self) -> dict[str, Any]:
        return document_of(self.at(self.trials - 1), self.at(self.trials))


def test_plant_now_is_the_plant_of_the_levels_now() -> None:
    now, coming = (0.8, 6.0, 1.1), (0.7, 9.0, 1.2)
    document = document_of(now, coming)
    plant, wanted, widths = ilc.Plant(document, 400).now(), ilc.Plant(model_of(*moved(*now)), 400), np.arange(0, 290.0)
    np.testing.assert_allclose(plant.level(widths), wanted.level(widths), atol=0.01)
    np.testing.assert_allclose(plant.response.cumsum(), wanted.response.cumsum(), atol=0.01)
    assert wanted.now() is wanted, "nothing is tracked"


def test_a_muscle_that_tires_is_followed() -> None:
    """A well-followed model leaves nearly the error of a muscle that does not change; without it, far more is left."""
    reference, last = ilc.Reference.reach(3.0), {}
    for name, muscle, tracked in (
        ("still", Tiring(0.0, 0.0, 0.0), False),
        ("tracked", Tiring(), True),
        ("untracked", Tiring(), False),
    ):
        trials = ilc.learn(muscle, model_of(*MODEL), reference, "norm-optimal", 10, tracked=tracked)
        last[name] = np.mean([trial.error_percent for trial in trials[-3:]])
    assert last["tracked"] < 1.4 * last["still"], last
    assert last["untracked"] > 2 * last["tracked"], last


def test_a_followed_model_is_waited_for() -> None:
    class Slow:
        asked = 0

        def approved_model(self, participant: str, known: Any, tracked: bool = False) -> Any:
            assert tracked and participant == "P" and (known is None) == (self.asked == 0)
            self.asked += 1
            return SimpleNamespace(document={"number": self.asked}, changed=self.asked == 3)

    assert ilc.Service(Slow(), "P").fetch_followed() == {"number": 3}


def test_it_stops_where_a_person_has_to_be_asked() -> None:
    asks = SimpleNamespace(document={"tracking": {"ask": "A new test is needed."}}, changed=True)
    client = SimpleNamespace(approved_model=lambda *_, **__: asks)
    for fetch in (ilc.Service.fetch_followed, ilc.Service.fetch):
        with pytest.raises(ilc.HaltedError, match="A new test is needed"):
            fetch(ilc.Service(client, "P"))
