"""The worker's side of tracking, with identify itself: recordings in, the model for the next trial out."""

from __future__ import annotations

from email.utils import parsedate_to_datetime
from pathlib import Path

import httpx
import numpy as np
import pytest

from stimrig.api.store.tables import Recording
from tests.api.conftest import REAL, Service, run_test, serving, soon, wait_done
from tests.api.test_tracked import play, say

pytestmark = pytest.mark.slow

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
