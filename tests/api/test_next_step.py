"""The line that says what is next: one table of states, and the page that shows and follows it."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import httpx
import pytest

from stimrig.api.store.tables import Model, Test
from stimrig.api.web.pages import next_view
from stimrig.api.web.pages.next_view import Situation, Today, next_step
from tests.api.conftest import Service, csrf, run_test, signed_in, wait_done

READY, DONE, POOR = Today("M1", "usable"), Today("M1", "usable", decided=True), Today("M1", "not usable")
TABLE: list[tuple[dict[str, Any], str, str, str]] = [
    # what is so; then: kind, a part of the words, where the button leads ("form": it starts the test; "": no button)
    ({}, "test", "Start the pre-session test", "form"),
    ({"calibration": "none", "may_start": False}, "calibrate", "Calibrate for today", "/participants/P1/calibration"),
    ({"calibration": "none"}, "calibrate", "Calibrate for today", "/participants/P1/calibration"),
    ({"calibration": "expired"}, "calibrate", "another day", "/participants/P1/calibration"),
    ({"rig": "calibrating", "holder": "P1"}, "calibrating", "has begun", "/participants/P1/calibration"),
    ({"rig": "calibrating", "holder": "P2"}, "wait", "in use for P2", ""),
    ({"running": "T1", "holder": "P1", "rig": "running"}, "running", "is running", "/tests/T1"),
    ({"rig": "running", "holder": "P2"}, "wait", "in use for P2", ""),
    ({"identifying": "T1"}, "identifying", "is being made", "/tests/T1"),
    ({"identifying": "T1", "rig": "latched"}, "identifying", "is being made", "/tests/T1"),
    ({"model": READY}, "look", "then approve or reject", "/models/M1"),
    ({"model": READY, "rig": "latched"}, "look", "then approve or reject", "/models/M1"),
    ({"model": READY, "calibration": "expired"}, "look", "then approve or reject", "/models/M1"),
    ({"model": READY, "served_until": "23:59"}, "look", "then approve or reject", "/models/M1"),
    ({"model": dataclasses.replace(READY, verdict="usable with care")}, "look", "Look at it", "/models/M1"),
    ({"model": DONE, "served_until": "23:59"}, "done", "today's model until 23:59", "/"),
    ({"model": DONE, "served_until": "23:59", "rig": "latched"}, "done", "until 23:59", "/"),
    ({"model": POOR, "served_until": "23:59"}, "done", "until 23:59", "/"),
    ({"model": DONE, "served_until": "23:59", "asked": True}, "asked", "new test is needed", "/participants/P1#trials"),
    ({"model": DONE, "asked": True}, "test", "Start the pre-session test", "form"),
    ({"model": DONE}, "test", "Start the pre-session test", "form"),
    ({"model": POOR}, "again", "is not usable. Test again", "form"),
    ({"model": POOR, "calibration": "expired"}, "calibrate", "not usable. The last", "/participants/P1/calibration"),
    ({"rejected": True}, "again", "was rejected. Test again", "form"),
    ({"ended": "stopped"}, "again", "was stopped. Test again", "form"),
    ({"ended": "stopped", "rig": "latched"}, "rearm", "needs a re-arm", ""),
    ({"ended": "fault"}, "again", "ended by a fault", "form"),
    ({"ended": "refused"}, "again", "was not started", "form"),
    ({"ended": "failed"}, "again", "gave no model", "form"),
    ({"rig": "latched"}, "rearm", "needs a re-arm", ""),
    ({"rig": "uncertain"}, "rearm", "needs a re-arm", ""),
    ({"rig": "latched", "calibration": "none", "may_start": False}, "rearm", "needs a re-arm", ""),
    ({"archived_since": "today"}, "archived", "In the archive since today", "/participants/P1/unarchive"),
    ({"archived_since": "today", "rig": "latched"}, "archived", "no test starts", "/participants/P1/unarchive"),
    ({"archived_since": "today", "model": READY}, "archived", "no test starts", "/participants/P1/unarchive"),
    ({"archived_since": "today", "running": "T1"}, "running", "is running", "/tests/T1"),
    ({"rig": "disconnected"}, "wait", "not connected", ""),
    ({"rig": "unreachable"}, "wait", "does not answer", ""),
    ({"rig": "silent"}, "wait", "does not answer", ""),
]  # fmt: skip


@pytest.mark.parametrize(("so", "kind", "words", "leads"), TABLE)
def test_each_state_has_one_step(so: dict[str, Any], kind: str, words: str, leads: str) -> None:
    step = next_step(Situation("P1", **so))
    assert (step.kind, step.href) == (kind, "" if leads == "form" else leads)
    assert words in step.words
    assert bool(step.button) == bool(leads), "a line without a way on has no button"


def test_the_table_names_every_kind_and_every_state_of_the_rig() -> None:
    from stimrig.api.web.pages.render import WORDS

    assert {kind for _, kind, _, _ in TABLE} == set(next_view.Kind.__args__)
    for state in WORDS:
        assert next_step(Situation("P1", rig=state)).words


def test_keys_tell_steps_apart() -> None:
    """A page that shows one step and hears of another key is out of date."""
    keys = {next_step(Situation("P1", **so)).key for so, *_ in TABLE}
    assert len(keys) > 15


# ---- the page -----------------------------------------------------------------------------------------------


def shown(service: Service, path: str = "/participants/P017") -> tuple[str, str]:
    """The line's key and words."""
    with signed_in(service) as browser:
        text = browser.get(path).text
        found = re.search(r'data-next="([^"]*)".*?data-words>(.*?)</b>', text, re.DOTALL)
        assert found, "the page has the line"
        assert text.count("data-next=") == 1
        if path.startswith("/participants"):
            assert browser.get(f"{path}/next").json() == {"key": found[1]}
    return found[1], found[2]


def test_the_line_goes_from_test_to_done(client: httpx.Client, service: Service, participant: str) -> None:
    assert shown(service)[0] == "calibrate may"
    model = run_test(client, participant)["model_id"]
    assert shown(service)[0] == f"look {model}"
    client.post(f"/v1/models/{model}/reject", json={"reason": "electrode slipped"})
    assert shown(service)[1].startswith("The last model was rejected.")
    second = run_test(client, participant)["model_id"]
    client.post(f"/v1/models/{second}/approve")
    assert shown(service)[0] == "done 23:59" == shown(service, f"/models/{second}")[0]
    better = client.post(f"/v1/models/{second}/effects", json={"effects": ["fatigue"]}).json()["id"]
    assert shown(service)[0] == f"look {better}"
    client.post(f"/v1/models/{better}/undo")
    assert shown(service)[0] == "done 23:59"


def test_a_model_of_another_day_is_not_todays(client: httpx.Client, service: Service, participant: str) -> None:
    document = run_test(client, participant)
    service.change(Model, document["model_id"], created_utc="2026-01-02T10:00:00.000Z")
    service.change(Test, document["id"], requested_utc="2026-01-02T09:00:00.000Z")
    assert shown(service)[0] == "calibrate may"


def test_of_two_versions_of_a_test_the_offered_one_is_next(client: httpx.Client, service: Service, participant: str):
    plain = run_test(client, participant)["model_id"]
    carried = client.post(f"/v1/models/{plain}/effects", json={"effects": ["fatigue"]}).json()["id"]
    for offered, expected in (("plain", plain), ("carried", carried)):
        told = {"offered": offered, "why": "plain-before", "from_model_id": plain}
        service.change(Model, carried, carried_from_id=plain, carried=told)
        assert shown(service)[0] == f"look {expected}"


def test_a_stopped_test_says_so_until_the_next_one(client: httpx.Client, service: Service, participant: str) -> None:
    service.rig.speed = 0.5
    test = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    assert shown(service)[0] == f"running {test}"
    client.post("/v1/stop")
    wait_done(client, test)
    assert shown(service)[0] == "rearm latched"
    client.post("/v1/rearm")
    assert shown(service)[1].startswith("The last test was stopped.")


def test_the_start_in_the_line_sets_what_was_typed(client: httpx.Client, pages: httpx.Client, participant: str) -> None:
    """It is a button of the limits' form: one click sets them and asks."""
    run_test(client, participant)
    seen = client.get("/v1/participants/P017").headers["etag"].strip('"')
    form = {"csrf": csrf(pages), "seen": seen, "current_ma": "19", "max_pulse_width_us": "300", "max_torque_nm": "30"}
    page = pages.get(pages.post("/participants/P017/tests", data=form).headers["location"]).text
    assert "19 mA" in page and "Start now" in page
