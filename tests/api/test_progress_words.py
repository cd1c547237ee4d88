"""Progress of long work in the words of the page's language, for the pages that wait and for the live page."""

from __future__ import annotations

import json
import time

from websockets.sync.client import connect

from tests.api.conftest import TOKEN, Service, run_test, shared_service
from tests.api.test_access import signed_in

GERMAN = {"Accept-Language": "de"}


service = shared_service()


def test_a_page_that_waits_reads_its_own_language(service: Service) -> None:
    slow = service.app.state.context.settings.recordings_dir / "slow"
    slow.parent.mkdir(parents=True, exist_ok=True)
    slow.write_text("0.4")
    with service.client() as http, signed_in(service) as browser:
        http.post("/v1/participants", json={"code": "G1"})
        model = run_test(http, "G1")["model_id"]
        job = http.get(f"/v1/models/{model}/diagnosis", params={"wait": False}).json()["id"]
        end = time.monotonic() + 30
        while not (now := browser.get(f"/jobs/now/{job}", headers=GERMAN).json())["text"]:
            assert time.monotonic() < end
        assert now == {"progress": 0.4, "text": "geprüft: Ermüdung", "time_left_s": now["time_left_s"], "done": False}
        assert http.get(f"/v1/jobs/{job}", headers=GERMAN).json()["text"] == "tried fatigue", "REST speaks English"
        slow.unlink()
        assert http.delete(f"/v1/jobs/{job}").is_success  # it would stand still for a minute


def test_the_live_page_hears_its_own_language(service: Service) -> None:
    carrying = service.app.state.context.settings.recordings_dir / "carrying-slowly"
    with service.client() as http:
        http.post("/v1/participants", json={"code": "G2"})
        first = run_test(http, "G2")["model_id"]
        added = http.post(f"/v1/models/{first}/effects", json={"effects": ["tremor"], "force": True, "reason": "seen"})
        http.post(f"/v1/models/{added.json()['id']}/approve", json={"reason": "follows the measurement well"})
        carrying.touch()
        test = http.post("/v1/tests", json={"participant": "G2"}).json()["id"]
        address = service.url.replace("http", "ws") + f"/v1/tests/{test}/live"
        with connect(address, additional_headers={"Authorization": f"Bearer {TOKEN}", **GERMAN}) as socket:
            heard = {}
            for message in map(json.loads, socket):
                if message["type"] == "test":
                    heard[(message["test"]["identification"] or {}).get("text")] = message["words"]["work"]
                if "fitting last session's structure" in heard:
                    carrying.unlink(missing_ok=True)
    assert heard["fitting last session's structure"] == "Anpassen der Struktur der letzten Sitzung"
