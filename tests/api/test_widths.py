"""A reference torque over HTTP and as a verb: widths by a real worker, refusals in words."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from stimrig import Client
from stimrig.api.cli import main
from stimrig.rig.messages import Bound
from tests.api.conftest import PATIENCE_S, REAL, TOKEN, Service, run_service
from tests.api.fake_rig import muscle
from tests.api.test_jobs import made_up_csv

TIME_S = np.arange(0, 6, 0.01)
WANTED_NM = 1.5 * np.sin(np.pi * TIME_S / 6) ** 2


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[tuple[Service, str]]:
    folder = tmp_path_factory.mktemp("widths")
    for service in run_service(folder, short_dir, REAL):
        service.rig.limits["width_rise_us"] = Bound(hi=50.0, unit="µs/pulse", owner="hard limit")
        service.rig.shortest_us = 45.0
        with service.client() as client:
            client.timeout = 120
            limits = {"current_ma": 20.0, "max_pulse_width_us": 250.0, "max_torque_nm": 30.0}
            client.post("/v1/participants", json={"code": "P1", "profile": limits})
            body = made_up_csv(folder / "record.csv").read_bytes()
            made = client.post("/v1/participants/P1/recordings", content=body)
            assert made.status_code == 201, made.text
            yield service, made.json()["model"]["id"]


@pytest.fixture
def service(served: tuple[Service, str]) -> Service:
    return served[0]


@pytest.fixture
def client(served: tuple[Service, str]) -> Iterator[httpx.Client]:
    with served[0].client(timeout=60) as client:
        yield client


def table(time_s: np.ndarray = TIME_S, torque_nm: np.ndarray = WANTED_NM) -> bytes:
    rows = [f"{at:.4f},{torque:.5f}" for at, torque in zip(time_s, torque_nm, strict=True)]
    return "\n".join(["time_s,torque_nm", *rows]).encode()


def test_the_muscle_follows_what_was_asked_for(served: tuple[Service, str]) -> None:
    service, model_id = served
    with Client(service.url, TOKEN, PATIENCE_S) as client:
        found = client.widths(model_id, WANTED_NM.tolist(), time_s=TIME_S.tolist())
        assert client.predict(model_id, found["pulse_width_us"]) == pytest.approx(
            found["predicted_torque_nm"], abs=1e-5
        )
        again = client.widths(model_id, found["reference_torque_nm"])
        assert again["pulse_width_us"] == found["pulse_width_us"]
    came = np.array(muscle(found["pulse_width_us"], 400.0)).reshape(-1, 10).mean(axis=1)
    wanted = np.array(found["reference_torque_nm"])
    assert np.linalg.norm(came - wanted) < 0.1 * np.linalg.norm(wanted)
    assert found["fit_percent"] > 95 and found["unreachable"] == []
    limits = ("max_pulse_width_us", "max_rise_us", "shortest_pulse_us")
    assert [found[name] for name in limits] == [250.0, 50.0, 45.0]
    assert {width for width in found["pulse_width_us"] if width < 45.0} == {0.0}, found["pulse_width_us"]
    rest, trial, _ = found["segments"]
    assert (rest["sequence"], trial["sequence"]) == ("rest", "widths")
    assert trial["settings"]["pulse_width_us"] == found["pulse_width_us"]


@pytest.mark.parametrize(("rate_hz", "status"), [(None, 200), (49.9, 200), (20.0, 422), (60.0, 422), (1e300, 422)])
def test_a_prediction_is_made_near_the_rate_of_the_model(
    client: httpx.Client, served: tuple[Service, str], rate_hz: float | None, status: int
) -> None:
    body = {"pulse_width_us": [1], **({} if rate_hz is None else {"pulse_rate_hz": rate_hz})}
    answer = client.post(f"/v1/models/{served[1]}/prediction", json=body)
    assert answer.status_code == status, answer.text
    assert status == 422 or answer.json()["pulse_rate_hz"] == (rate_hz or 40.0)


def test_the_participants_limit_holds_and_what_is_beyond_is_named(client: httpx.Client, served: tuple[Service, str]):
    wanted = [0.0] * 20 + [50.0] * 80
    ask = f"/v1/models/{served[1]}/widths"
    found = client.post(ask, json={"reference_torque_nm": wanted, "max_pulse_width_us": 400.0}).json()
    assert max(found["pulse_width_us"]) == 250.0
    assert "above-plateau" in {one["reason"] for one in found["unreachable"]}
    narrow = client.post(ask, json={"reference_torque_nm": wanted, "max_pulse_width_us": 180.0}).json()
    assert max(narrow["pulse_width_us"]) == 180.0
    slow = client.post(ask, json={"reference_torque_nm": wanted, "max_rise_us": 46.0}).json()
    assert 45.0 <= np.max(np.diff(slow["pulse_width_us"], prepend=0.0)) <= 46.0
    stuck = client.post(ask, json={"reference_torque_nm": wanted, "max_rise_us": 44.0})
    assert stuck.status_code == 422 and "no pulse below 45 µs. Allow more" in stuck.json()["detail"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "reference_torque_nm"),
        ({"reference_torque_nm": []}, "reference_torque_nm"),
        ({"reference_torque_nm": [True]}, "reference_torque_nm"),
        ({"reference_torque_nm": [1.0, 2.0], "time_s": [0.0]}, "ne time for each torque"),
        ({"reference_torque_nm": [1.0, 2.0], "time_s": [0.5, 0.0]}, "must rise"),
        ({"reference_torque_nm": [1e5]}, "mN·m"),
        ({"reference_torque_nm": [0.0] * 12_001}, "at most 300 s"),
        ({"reference_torque_nm": [1.0], "pulse_rate_hz": 20.0}, "40 pulses a second"),
        ({"reference_torque_nm": [1.0], "max_pulse_width_us": 0.0}, "max_pulse_width_us"),
        ({"reference_torque_nm": [1.0], "further": 1}, "further"),
        ({"reference_torque_nm": [1.0], "table": "torque_nm\n1\n"}, "table"),
    ],
)
def test_a_senseless_reference_is_refused_in_words(
    client: httpx.Client, served: tuple[Service, str], body: dict[str, object], words: str
) -> None:
    answer = client.post(f"/v1/models/{served[1]}/widths", json=body)
    assert answer.status_code == 422 and words in answer.text, answer.text


def test_a_table_says_the_same_as_its_numbers(client: httpx.Client, served: tuple[Service, str]) -> None:
    numbers = {"reference_torque_nm": WANTED_NM.round(5).tolist(), "time_s": TIME_S.round(4).tolist()}
    asked = numbers, {"table": table().decode()}
    first, second = (client.post(f"/v1/models/{served[1]}/widths", json=body).json() for body in asked)
    assert first == second


def test_the_verb_writes_the_same_table(
    served: tuple[Service, str], client: httpx.Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, reference, out = (tmp_path / name for name in ("MODEL.json", "reference.csv", "widths.csv"))
    model.write_bytes(client.get(f"/v1/models/{served[1]}/file").content)
    reference.write_bytes(table())
    options = ["invert", str(model), str(reference), "-o", str(out), "--largest-us", "250", "--shortest-us", "45"]
    assert main.run([*options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    body = {"reference_torque_nm": WANTED_NM.tolist(), "time_s": TIME_S.tolist()}
    asked = client.post(f"/v1/models/{served[1]}/widths", json=body).json()
    assert found["pulse_width_us"] == pytest.approx(asked["pulse_width_us"], abs=1.0)
    rows = list(csv.DictReader(out.open()))
    assert [float(row["pulse_width_us"]) for row in rows] == found["pulse_width_us"]
    reference.write_bytes(table(torque_nm=20 * WANTED_NM))
    assert main.run(options) == 0 and "above-plateau" in capsys.readouterr().out
    reference.write_text("nothing")
    assert main.run(options) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "reference.csv, line 1" in said and "torque_nm" in said
