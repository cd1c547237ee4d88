"""A trial foretold over HTTP, by a real worker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from api.workers.pool import WORKER
from tests.api.conftest import run_service
from tests.api.fake_rig import muscle
from tests.api.test_worker import made_up_csv


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory, short_dir: Path) -> Iterator[tuple[httpx.Client, str]]:
    folder = tmp_path_factory.mktemp("prediction")
    for service in run_service(folder, short_dir, WORKER):
        with service.client() as client:
            client.timeout = 120
            client.post("/v1/participants", json={"code": "P1"})
            body = made_up_csv(folder / "record.csv").read_bytes()
            made = client.post("/v1/participants/P1/recordings", content=body)
            assert made.status_code == 201, made.text
            yield client, made.json()["model"]["id"]


def test_foretold_torque_is_the_muscles(model: tuple[httpx.Client, str]) -> None:
    client, model_id = model
    widths = [0.0] * 20 + [200.0] * 60 + [90.0] * 60 + [0.0] * 40
    found = client.post(f"/v1/models/{model_id}/prediction", json={"pulse_width_us": widths}).json()
    truth = np.array(muscle(widths, 400.0)).reshape(-1, 10).mean(axis=1)
    assert len(found["torque_nm"]) == len(widths)
    assert np.sqrt(np.mean((np.array(found["torque_nm"]) - truth) ** 2)) < 0.15
    assert max(abs(value) for value in found["torque_nm"][:18]) < 0.02, "no pulse, no torque"


@pytest.mark.parametrize("body", [{"pulse_width_us": []}, {"pulse_width_us": [-1]}, {"pulse_width_us": [1e9]}, {}])
def test_senseless_widths_are_refused(model: tuple[httpx.Client, str], body: dict[str, list[float]]) -> None:
    client, model_id = model
    assert client.post(f"/v1/models/{model_id}/prediction", json=body).status_code == 422
    assert client.post("/v1/models/none/prediction", json={"pulse_width_us": [1]}).status_code == 404
