"""The line that says what is next: one table of states, and the page that shows and follows it."""

from __future__ import annotations

import html
import re
from typing import Any

import httpx
import pytest

from stimrig.api.store.tables import Model, Test
from stimrig.api.web.pages import next_view
from stimrig.api.web.pages.next_view import next_step
from tests.api.conftest import Service, run_test, signed_in, wait_done

READY, POOR, REJECTED = {"undecided": "M1"}, {"last_model": "poor"}, {"last_model": "rejected"}
RUNS = {"test": "T1", "state": "running", "rig": "running", "holder": "P1"}
SERVED = {"served_until": "23:59"}
TRIAL = {**SERVED, "of": "trial"}
TABLE: list[tuple[dict[str, Any], str, str, str]] = [
    # what is so; then: kind, a part of the words, where the button leads ("form": it is a form's own; "": no button)
    ({}, "test", "Start the pre-session test", "form"),
    ({"calibration": "none"}, "calibrate", "Calibrate for today", "form"),
    ({"calibration": "expired"}, "calibrate", "another day", "form"),
    ({"rig": "calibrating", "holder": "P1"}, "calibrating", "has begun", "/participants/P1/calibration"),
    ({"unstored": True}, "calibrating", "waits to be stored", "/participants/P1/calibration"),
    ({"rig": "calibrating", "holder": "P2"}, "wait", "in use for P2", ""),
    # a test under way, whatever else there is
    (RUNS, "running", "The test is running", "/tests/T1"),
    ({**RUNS, **READY}, "running", "The test is running", "/tests/T1"),
    ({**RUNS, "rig": "stopping"}, "running", "is being stopped", "/tests/T1"),
    ({**RUNS, "rig": "unreachable"}, "running", "last heard of", "/tests/T1"),
    ({**RUNS, "state": "sealing"}, "identifying", "is being saved", "/tests/T1"),
    ({**TRIAL, **RUNS}, "running", "The controller plays a trial.", "/tests/T1"),
    ({"state": "identifying", "test": "T1"}, "identifying", "is being made", "/tests/T1"),
    ({"state": "identifying", "test": "T1", "rig": "silent"}, "identifying", "is being made", "/tests/T1"),
    ({"rig": "running", "holder": "P2"}, "wait", "in use for P2", ""),
    ({"rig": "running"}, "wait", "is in use. Wait", ""),
    # a model waits for a decision
    (READY, "look", "The model is ready. Look at it, then approve or reject", "/models/M1"),
    ({**READY, "rig": "latched"}, "look", "then approve or reject", "/models/M1"),
    ({**READY, "state": "stopped"}, "look", "was stopped. The model is ready", "/models/M1"),
    ({**READY, "served_until": "23:59"}, "look", "then approve or reject", "/models/M1"),
    ({**READY, "of": "joint", "state": "completed"}, "look", "The model is ready.", "/models/M1"),
    # the controller has one
    (SERVED, "done", "Done. The controller has today's model until 23:59", "/"),
    ({**SERVED, "lacks_key": "mine"}, "done", "Today's model is approved until 23:59, but no controller has a key",
     "/participants/P1#keys"),
    ({**SERVED, "lacks_key": "another's"}, "done", "no controller has a key", "/"),
    ({**SERVED, "lacks_key": "mine", "rig": "latched"}, "rearm", "no controller has a key yet. The rig has", ""),
    ({**SERVED, "holder": "P2", "rig": "running"}, "done", "until 23:59", "/"),
    ({**SERVED, "rig": "latched"}, "rearm", "until 23:59. The rig has stopped and needs a re-arm", ""),
    ({**SERVED, "rig": "silent"}, "wait", "until 23:59. The rig does not answer", ""),
    ({**SERVED, **POOR}, "done", "until 23:59", "/"),
    ({**SERVED, "state": "stopped"}, "done", "The last test was stopped. The controller has", "/"),
    ({**TRIAL, "state": "completed"}, "done", "Done. The controller has", "/"),
    ({**TRIAL, "state": "stopped"}, "done", "The last trial was stopped. The controller has", "/"),
    ({**TRIAL, "state": "failed"}, "done", "The last trial was not finished.", "/"),
    ({**SERVED, "needs_test": True}, "asked", "new test is needed", "/participants/P1#trials"),
    ({**SERVED, "of": "joint", "state": "completed"}, "joint", "Go on with", "/participants/P1/joint"),
    # nothing to serve
    ({"of": "trial", "state": "stopped"}, "test", "trial was stopped. Calibrated. Start", "form"),
    ({"of": "joint", "state": "completed"}, "joint", "Go on with the tests of the joint", "/participants/P1/joint"),
    ({"of": "joint", "state": "stopped"}, "joint", "was stopped. Go on with", "/participants/P1/joint"),
    ({"of": "joint", "state": "stopped", "calibration": "none"}, "calibrate", "was stopped. Calibrate", "form"),
    (POOR, "again", "is not usable. Test again", "form"),
    ({**POOR, "calibration": "expired"}, "calibrate", "not usable. The last", "form"),
    (REJECTED, "again", "was rejected. Test again", "form"),
    ({"state": "stopped"}, "again", "was stopped. Test again", "form"),
    ({"state": "fault"}, "again", "ended by a fault", "form"),
    ({"state": "refused"}, "again", "was not started", "form"),
    ({"state": "failed"}, "again", "gave no model", "form"),
    # nothing starts
    ({"rig": "latched"}, "rearm", "needs a re-arm", ""),
    ({"rig": "uncertain"}, "rearm", "needs a re-arm", ""),
    ({"rig": "disconnected"}, "wait", "not connected", ""),
    ({"rig": "silent"}, "wait", "does not answer", ""),
]  # fmt: skip


@pytest.mark.parametrize(("so", "kind", "words", "leads"), TABLE)
def test_each_state_has_one_step(so: dict[str, Any], kind: str, words: str, leads: str) -> None:
    step = next_step("P1", **so)
    assert (step.kind, step.href) == (kind, "" if leads == "form" else leads)
    assert words in step.words
    assert bool(step.button) == bool(leads), "a line without a way on has no button"


def test_the_table_names_every_kind_and_every_state_of_the_rig() -> None:
    from stimrig.api.web.pages.render import WORDS

    assert {kind for _, kind, _, _ in TABLE} == set(next_view.Kind.__args__)
    for state in WORDS:
        assert next_step("P1", rig=state).words


def test_keys_change_with_what_is_shown_and_with_nothing_else() -> None:
    """A page that shows one line and hears of another key is out of date."""
    steps = [next_step("P1", **so) for so, *_ in TABLE]
    shown = {(step.kind, step.words, step.button, step.href): step.key for step in steps}
    assert len(set(shown.values())) == len(shown) > 35
    assert all(step.key == shown[step.kind, step.words, step.button, step.href] for step in steps)


# ---- the page -----------------------------------------------------------------------------------------------


def shown(service: Service, path: str = "/participants/P017") -> tuple[str, str]:
    """The line's kind with what it is about, and its words."""
    with signed_in(service) as browser:
        text = browser.get(path).text
        found = re.search(r'data-next-key="([^"]*)".*?data-words>(.*?)</b>', text, re.DOTALL)
        assert found, "the page has the line"
        assert text.count("data-next-key=") == 1
        section = text[found.start() : text.index("</section>", found.end())]
        assert len(re.findall(r"<button|<a ", section)) <= 1
        code = re.search(r'data-from="/participants/([^/"]*)/next"', text)
        assert code and browser.get(f"/participants/{code[1]}/next").json()["key"] == found[1]
    leads = re.search(r'href="/(?:tests|models)/([^"]*)"', section)
    return f"{found[1].split()[0]} {leads[1] if leads else ''}".strip(), html.unescape(found[2])


PLAN = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_duration_s": 15.0, "trials": 20}
KEYLESS_NOW = ("done", "Today's model is approved until 23:59, but no controller has a key yet.")
DONE_NOW = ("done", "Done. The controller has today's model until 23:59.")


def test_the_line_goes_from_test_to_done(client: httpx.Client, service: Service, participant: str) -> None:
    assert shown(service)[0] == "calibrate"
    model = run_test(client, participant)["model_id"]
    assert shown(service)[0] == f"look {model}"
    client.post(f"/v1/models/{model}/reject", json={"reason": "electrode slipped"})
    assert shown(service)[1].startswith("The last model was rejected.")
    second = run_test(client, participant)["model_id"]
    client.post(f"/v1/models/{second}/approve")
    assert shown(service) == shown(service, f"/models/{second}") == KEYLESS_NOW
    assert client.post(f"/v1/participants/{participant}/keys", json={"name": "arm", **PLAN}).status_code == 201
    assert shown(service) == shown(service, f"/models/{second}") == DONE_NOW
    better = client.post(f"/v1/models/{second}/effects", json={"effects": ["fatigue"]}).json()["id"]
    assert shown(service)[0] == f"look {better}"
    client.post(f"/v1/models/{better}/reject")
    assert shown(service) == DONE_NOW
    for document in service.context.store.all(Test):
        service.change(Test, document.id, requested_utc="2026-01-02T09:00:00.000Z")
    for version in service.context.store.all(Model):
        service.change(Model, version.id, created_utc="2026-01-02T10:00:00.000Z")
    client.post(f"/v1/models/{second}/reject")
    assert shown(service)[1].startswith("Calibrate for today"), "models of another day are not today's"


def test_of_two_versions_of_a_test_the_offered_one_is_next(client: httpx.Client, service: Service, participant: str):
    plain = run_test(client, participant)["model_id"]
    carried = client.post(f"/v1/models/{plain}/effects", json={"effects": ["fatigue"]}).json()["id"]
    for offered, expected in (("plain", plain), ("carried", carried)):
        told = {"offered": offered, "why": "plain-before", "from_model_id": plain}
        service.change(Model, carried, carried_from_id=plain, carried=told)
        assert shown(service)[0] == f"look {expected}"


def test_while_a_trial_plays_the_line_says_so_and_after_it_what_became_of_it(
    client: httpx.Client, service: Service, approved: str
) -> None:
    service.rig.speed = 0.5
    trial = client.post("/v1/tests", json={"participant": "P017", "kind": "sequence"}).json()["id"]
    for path in ("/participants/P017", f"/models/{approved}"):
        assert shown(service, path) == (f"running {trial}", "The controller plays a trial.")
    client.post("/v1/stop")
    wait_done(client, trial)
    assert shown(service)[1].startswith("The controller has today's model until 23:59. The rig has stopped")
    client.post("/v1/rearm")
    assert shown(service) == ("done", "The last trial was stopped. The controller has today's model until 23:59.")


def test_a_test_that_goes_on_over_midnight_is_still_running(client: httpx.Client, service: Service, participant: str):
    service.rig.speed = 0.5
    test = client.post("/v1/tests", json={"participant": participant}).json()["id"]
    service.change(Test, test, requested_utc="2026-01-02T22:59:30.000Z")
    assert shown(service) == (f"running {test}", "The test is running.")
    client.post("/v1/stop")
    wait_done(client, test)
