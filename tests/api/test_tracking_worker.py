"""The worker's side of tracking, with identify itself: recordings in, the model for the next trial out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.api.models.tracking import Limits
from stimrig.api.workers import tracking_verbs
from stimrig.identify import tracking
from stimrig.rig import messages as m
from tests.api.fake_rig import PATIENT, write_recording
from tests.harness.sessions import Planned, record

RATE_HZ = 400
WIDE = Limits(60.0, 60.0, 60.0).bounds(80.0)
WIDTHS = np.concatenate([
    np.zeros(40), np.linspace(0.0, 200.0, 80), np.full(60, 200.0), np.linspace(200.0, 120.0, 60), np.full(80, 120.0),
    np.linspace(120.0, 0.0, 120), np.zeros(40),
]).round()  # fmt: skip


def silent(_share: float, _text: str = "") -> None:
    """Progress that nobody looks at."""


@pytest.fixture(scope="module")
def model_json() -> str:
    return identify.fit(record(Planned(PATIENT, 0.0), 3)).to_json()


def recorded(folder: Path, gain: float, offset_nm: float = 0.0) -> str:
    """A trial's sealed recording; the load cell reads `offset_nm` at rest."""
    muscle = replace(PATIENT, gain=gain * PATIENT.gain)
    noise = 0.04 * np.random.default_rng(round(100 * gain)).standard_normal(WIDTHS.size * RATE_HZ // 40)
    torque = muscle.torque(WIDTHS, RATE_HZ) + noise + offset_nm
    profile = m.Profile(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0)
    plan = m.TestPlan(test_id=f"T{gain:g}", participant="P", kind="sequence", profile=profile)
    segments = [{"name": "trial", "start_s": 0.0, "end_s": WIDTHS.size / 40}]
    path, _ = write_recording(folder, plan, WIDTHS.tolist(), torque.tolist(), segments, RATE_HZ, "completed")
    return str(path)


def follow(data: str, model_json: str, **more: Any) -> dict[str, Any]:
    return tracking_verbs.track(data, silent, **{"model_json": model_json, "bounds": WIDE} | more)


def test_trials_of_a_muscle_that_tires_are_followed_to_the_model_of_the_next(model_json: str, tmp_path: Path) -> None:
    state = None
    for gain in (0.98, 0.95, 0.92, 0.89):
        found = follow(recorded(tmp_path, gain), model_json, state=state)
        state = json.loads(json.dumps(found["step"]))["state"]
    band = found["step"]["now"]["gain"]
    assert band["value"] == pytest.approx(0.89, abs=0.02) and band["low"] < band["value"] < band["high"]
    coming = found["step"]["coming"]["gain"]["value"]
    assert coming < band["value"], "it goes on tiring"
    moved, approved = identify.Model.from_json(found["model"]), identify.Model.from_json(model_json)
    ratio = moved.figures()["plateau_nm"]["value"] / approved.figures()["plateau_nm"]["value"]
    assert ratio == pytest.approx(coming, rel=0.01)


def test_what_a_person_does_not_let_move_stays(model_json: str, tmp_path: Path) -> None:
    found = follow(recorded(tmp_path, 0.9), model_json, bounds={"time_scale": (0.5, 1.5)})
    moved, approved = identify.Model.from_json(found["model"]), identify.Model.from_json(model_json)
    assert moved.recruitment.table()[1] == pytest.approx(approved.recruitment.table()[1])
    assert found["step"]["now"]["gain"]["value"] < 0.95, "it is seen all the same"


def test_the_shape_of_the_curve_moves_no_torque_beyond_what_the_gain_may(model_json: str, tmp_path: Path) -> None:
    data, approved = recorded(tmp_path, 0.95), identify.Model.from_json(model_json)

    def served(low: float, high: float) -> tuple[np.ndarray, float]:
        found = follow(data, model_json, bounds={"gain": (low, high)})
        torque_nm = approved.recruitment.table()[0]
        moved = identify.Model.from_json(found["model"]).recruitment(torque_nm)
        return moved - gain_of(found) * approved.recruitment(torque_nm), gain_of(found)

    def gain_of(found: dict[str, Any]) -> float:
        return float(found["step"]["coming"]["gain"]["value"])

    shape_nm, gain = served(0.5, 1.5)
    assert np.max(np.abs(shape_nm)) > 1e-4, "the shape is corrected, too"
    assert np.max(np.abs(served(gain - 1e-6, gain + 1e-6)[0])) < 1e-9, "not where that would pass the limit"


def test_a_trial_in_between_that_was_not_followed_widens_what_is_expected(model_json: str, tmp_path: Path) -> None:
    data = recorded(tmp_path, 0.97)
    state = follow(data, model_json)["step"]["state"]
    sure, unsure = (follow(data, model_json, state=state, missed=missed)["step"]["distance"] for missed in (0, 10))
    assert unsure < sure
    many = follow(data, model_json, state=state, missed=10**9)
    assert np.isfinite(many["step"]["now"]["gain"]["value"])


def test_another_pulse_rate_and_other_dynamics_are_no_trial(model_json: str, tmp_path: Path) -> None:
    document = json.loads(model_json) | {"pulse_rate_hz": 20.0}
    found = follow(recorded(tmp_path, 0.96), json.dumps(document))
    assert "pulses a second" in found["reason"] and "step" not in found
    other = identify.fit(record(Planned(PATIENT, 0.0), 3), method="narx").to_json()
    found = follow(recorded(tmp_path, 0.96), other)
    assert "cannot be tracked" in found["reason"] and "step" not in found
    assert tracking_verbs.warm(silent, other) == {}, "that is said after a trial, not before"


def test_a_recording_that_cannot_be_read_is_told_as_such(model_json: str, tmp_path: Path) -> None:
    broken = tmp_path / "R-broken.h5"
    broken.write_bytes(b"nothing of the kind" * 100)
    with pytest.raises(identify.BadRecord):
        follow(str(broken), model_json)


def test_the_error_is_that_of_the_torque_above_rest(model_json: str, tmp_path: Path) -> None:
    clean = PATIENT.torque(WIDTHS, RATE_HZ).reshape(WIDTHS.size, -1).mean(axis=1)
    for offset_nm in (0.0, 1.5):
        data = recorded(tmp_path, 1.0, offset_nm)
        assert follow(data, model_json, reference_torque_nm=clean.tolist())["error_percent"] < 1.0
        tenth = follow(data, model_json, reference_torque_nm=(clean / 1.1).tolist())["error_percent"]
        assert tenth == pytest.approx(10.0, abs=1.0)
    assert follow(data, model_json)["error_percent"] is None
    assert follow(data, model_json, reference_torque_nm=[0.0] * WIDTHS.size)["error_percent"] is None


def test_a_person_who_tired_in_earlier_sessions_is_expected_to(model_json: str, tmp_path: Path) -> None:
    def told(gain: float) -> dict[str, Any]:
        values = {"gain": gain, "threshold_shift_us": 0.0, "time_scale": 1.0}
        return {name: {"value": value, "low": value, "high": value} for name, value in values.items()}

    data, earlier = recorded(tmp_path, 0.95), [[told(0.95**trial) for trial in range(1, 6)]] * 4
    usual, known = (
        follow(data, model_json, **more)["step"]["coming"]["gain"]["value"] for more in ({}, {"earlier": earlier})
    )
    assert known < usual - 0.02


def test_warming_follows_a_trial_of_its_own(model_json: str, monkeypatch: pytest.MonkeyPatch) -> None:
    followed: list[float] = []
    own = tracking.follow

    def noted(model: Any, state: Any, record: identify.Record) -> Any:
        followed.append(float(np.ptp(record.torque_nm)))
        return own(model, state, record)

    monkeypatch.setattr(tracking, "follow", noted)
    assert tracking_verbs.warm(silent, model_json) == {}
    assert len(followed) == 1 and followed[0] > 1.0
