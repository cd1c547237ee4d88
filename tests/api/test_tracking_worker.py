"""The worker's side of tracking, with identify itself: recordings in, the model for the next trial out."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import h5py
import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.jobs import tracking as tracking_verbs
from stimrig.api.models.tracking import Limits
from stimrig.api.store.tables import Recording
from stimrig.identify import tracking
from stimrig.rig import messages as m
from tests.api.conftest import REAL, Service, run_test, serving, soon, wait_done
from tests.api.fake_rig import PATIENT, write_recording
from tests.api.test_tracked import play, say
from tests.harness.sessions import Planned, record

pytestmark = pytest.mark.slow

RATE_HZ = 400
WIDE = Limits(gain_percent=60.0, threshold_percent=60.0, time_scale_percent=60.0).bounds(80.0)
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
    assert tracking_verbs.track_warm(silent, other) == {}, "that is said after a trial, not before"


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
    assert tracking_verbs.track_warm(silent, model_json) == {}
    assert len(followed) == 1 and followed[0] > 1.0


# ---- What the muscle did between two trials: the service passes it on, the worker carries its effects through it


def passed_on(service: Service, approval_id: int) -> list[list[str]]:
    """For each trial that was followed, the recordings that the worker was given beside its own."""
    store = service.context.store
    names = {row.path: row.id for row in store.all(Recording)}
    rows = service.context.tracked.rows(approval_id)
    return [[names[path] for path in row.step["state"]["between"]] for row in rows if row.step is not None]


def test_the_worker_is_given_what_was_played_since(service: Service, client: httpx.Client, participant: str) -> None:
    tested = run_test(client, participant)
    plain = tested["model_id"]
    assert client.post(f"/v1/models/{plain}/approve").status_code == 200
    first = play(client)
    soon(lambda: passed_on(service, 1) == [[]])  # a model without effects
    added = client.post(f"/v1/models/{plain}/effects", json={"effects": ["fatigue"]}).json()["id"]
    assert client.post(f"/v1/models/{added}/approve").status_code == 200
    play(client)
    say(service, reason="It cannot be read.")
    missed = play(client)
    client.put(f"/v1/participants/{participant}/profile", json={"current_ma": 15.0})
    play(client)  # at another current: nobody knows how much it tires
    client.put(f"/v1/participants/{participant}/profile", json={"current_ma": 20.0})
    play(client)
    play(client)
    expected = [[tested["recording_id"], first["recording_id"]], [missed["recording_id"]], []]
    soon(lambda: passed_on(service, 2) == expected)


def at(path: str, unix_s: float) -> str:
    """The recording, begun then."""
    with h5py.File(path, "a") as file:
        file.attrs["created_utc"] = datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
    return path


@pytest.fixture(scope="module")
def tiring_json() -> str:
    """A model with the effect fatigue."""
    document = identify.fit(record(Planned(PATIENT, 0.0), 3)).to_dict()
    values = {"depth": 0.6, "onset_s": 30.0, "recovery_s": 60.0}
    settings = {"scale_nm": PATIENT.gain}
    document["effects"] = [{"id": "fatigue", "form": "fitness", "parameters": values, "settings": settings}]
    return json.dumps(document)


def states(data: str, model_json: str, **more: Any) -> dict[str, float]:
    found = follow(data, model_json, **more)
    told = found["step"]["effects"]["fatigue"]
    assert json.loads(found["model"])["effects"][0]["state"] == pytest.approx(told["coming"])
    return told


def test_the_worker_carries_the_states_through_it(tiring_json: str, tmp_path: Path) -> None:
    test, trial = at(recorded(tmp_path, 1.0), 1e9), at(recorded(tmp_path, 0.9), 1e9 + 32.0)
    alone = states(trial, tiring_json)
    after = states(trial, tiring_json, between=[test])
    broken = tmp_path / "R-broken.h5"
    broken.write_bytes(b"nothing of the kind" * 100)
    assert after["now"] > alone["now"] + 0.05 and 0.0 < after["coming"] < after["now"]
    assert states(trial, tiring_json, between=[test, str(broken), str(tmp_path / "R-gone.h5")]) == after
    assert states(at(trial, 1e9 + 9e4), tiring_json, between=[test])["now"] == pytest.approx(alone["now"], abs=1e-6)


def test_a_model_without_such_effects_reads_no_further_recording(
    tiring_json: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = json.dumps(json.loads(tiring_json) | {"effects": []})
    test, trial = recorded(tmp_path, 1.0), recorded(tmp_path, 0.9)
    read: list[Path] = []
    dated = tracking_verbs.dated
    monkeypatch.setattr(tracking_verbs, "dated", lambda path: (read.append(path), dated(path))[1])
    assert follow(trial, plain, between=[test])["step"]["effects"] == {}
    assert read == [Path(trial)]


# ---- from a trial to the tracked model that is served; nothing is stubbed but the rig ----------------------------

PERSON = "/v1/participants/P1"
TRIAL_US = np.r_[np.zeros(40), np.linspace(0, 160, 100), np.full(60, 160.0), np.linspace(160, 0, 100), np.zeros(40)]
TRIAL = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": TRIAL_US.round().tolist()}}]
BODY = {"participant": "P1", "kind": "sequence", "segments": TRIAL}


def test_a_muscle_that_stays_is_followed_through_the_service(tmp_path: Path, short_dir: Path) -> None:
    with serving(tmp_path, short_dir, REAL) as (_, client):
        client.timeout = 300
        client.post("/v1/participants", json={"code": "P1"})
        test = run_test(client, "P1", 300)
        assert client.post(f"/v1/models/{test['model_id']}/approve").status_code == 200
        for number in (1, 2):
            wait_done(client, client.post("/v1/tests", json=BODY).json()["id"], 300)
            served = client.get(f"{PERSON}/model", params={"tracked": True})
            for _ in range(60):  # a fetch waits two seconds at most, and the first trial may wait for the worker
                if served.json().get("tracking", {}).get("trial") == number:
                    break
                served = client.get(f"{PERSON}/model", params={"tracked": True})
        document, plain = served.json(), client.get(f"{PERSON}/model").json()
        told = document["tracking"]
        (one, two) = client.get(f"{PERSON}/tracking").json()["trials"]
        assert told["trial"] == 2 and told["ask"] is None and two["outcome"] == "followed", (one, two)
        gain = told["now"]["gain"]
        assert gain["low"] < 1.0 < gain["high"] and gain["high"] - gain["low"] < 0.2
        moved, approved = (np.array(d["recruitment"]["torque_nm"]) for d in (document, plain))
        assert moved[-1] / approved[-1] == pytest.approx(told["coming"]["gain"]["value"], abs=0.02)
        assert parsedate_to_datetime(served.headers["last-modified"]).isoformat()[:19] == two["at_utc"][:19]
        wanted = {"reference_torque_nm": np.r_[np.zeros(20), np.full(60, 1.0)].tolist()}
        widths = client.post(f"/v1/models/{document['model_id']}/widths", json=wanted)
        assert widths.status_code == 200, widths.text
        assert widths.json()["predicted_torque_nm"][-1] == pytest.approx(1.0, abs=0.1)
