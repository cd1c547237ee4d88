"""From a trial's recording to the tracked model that is served, by a real worker; nothing is stubbed but the rig."""

from __future__ import annotations

from email.utils import parsedate_to_datetime
from pathlib import Path

import numpy as np
import pytest

from stimrig.api.workers.pool import WORKER
from tests.api.conftest import run_service, run_test, wait_done

PERSON = "/v1/participants/P1"
WIDTHS = np.r_[np.zeros(40), np.linspace(0, 160, 100), np.full(60, 160.0), np.linspace(160, 0, 100), np.zeros(40)]
TRIAL = [{"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": WIDTHS.round().tolist()}}]
BODY = {"participant": "P1", "kind": "sequence", "segments": TRIAL}


def test_a_muscle_that_stays_is_followed_through_the_service(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, WORKER):
        with service.client() as client:
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
