"""A model that is not usable reaches a controller only with a reason that is one; a usable one with none."""

from __future__ import annotations

import inspect
import itertools
import json
import re
import time
from typing import Any

import httpx
import pytest

from stimrig.api.models import advice, registry
from stimrig.identify.estimation import quality
from tests.api.conftest import Service, run_test
from tests.api.test_access import csrf, signed_in

NONE = ["", " ", ".", "ok", "asdf", "......", "xxxxxxxxxxxx", "asdf asdf asdf", "a b c", "aaaa bbbb cccc dddd",
        "1234 5678 9012", "ja ja ja ja", "ok ok ok", "test test test test"]  # fmt: skip
SOME = ["only the delay is used today", "Nur die Verzögerung wird heute gebraucht", "plateau measured twice, same",
        "Engineer Kim watches every trial"]  # fmt: skip


def make_poor(service: Service, model: str) -> str:
    """A version of the same recording that identify would call not usable."""
    context = service.app.state.context
    row = context.versions.get(model)
    document = json.loads(row.document) | {"model_id": f"M-poor{time.time_ns()}"}
    says = "stimulation hardly changes the torque: check electrodes, current and load cell"
    document["fit"] = document["fit"] | {"held_out_fit_percent": 69.0}
    document["quality"] = {
        "verdict": "not usable", "words": f"Do not use this model: {says}.", "reasons": [says],
        "gates": {"torque": {"passed": False, "severity": "refuse", "says": says}},
    }  # fmt: skip
    return context.versions.add(json.dumps(document), row.participant, row.recording_id, "a test").id


@pytest.mark.parametrize("text", NONE)
def test_no_reason(text: str) -> None:
    assert not registry.is_reason(text)


@pytest.mark.parametrize("text", SOME)
def test_a_reason(text: str) -> None:
    assert registry.is_reason(text)


def test_the_api_wants_a_reason_for_a_model_that_is_not_usable(
    client: httpx.Client, service: Service, participant: str
) -> None:
    model = run_test(client, participant)["model_id"]
    poor = make_poor(service, model)
    for body in (None, {}, {"reason": "ok"}, {"reason": "asdf asdf asdf"}):
        refused = client.post(f"/v1/models/{poor}/approve", json=body)
        assert refused.status_code == 422 and refused.json()["type"] == "/problems/reason-needed", body
        assert "Write in a few words why" in refused.json()["detail"]
    assert client.get("/v1/participants/P017/model").status_code == 404
    assert client.get(f"/v1/models/{poor}").json()["decision"] is None
    assert client.post(f"/v1/models/{poor}/approve", json={"reason": SOME[0]}).json()["served"]
    assert client.post(f"/v1/models/{poor}/reject").json()["decision"] == "rejected", "to reject needs none"
    assert client.post(f"/v1/models/{model}/approve").json()["served"], "nor does a usable one"


def test_undo_brings_no_model_into_use_that_is_not_usable(
    client: httpx.Client, service: Service, participant: str
) -> None:
    poor = make_poor(service, run_test(client, participant)["model_id"])
    better = client.post(f"/v1/models/{poor}/effects", json={"effects": ["fatigue"]}).json()["id"]
    client.post(f"/v1/models/{better}/approve")
    assert client.post(f"/v1/models/{better}/undo").json()["id"] == poor
    assert client.get("/v1/participants/P017/model").status_code == 404


def test_the_form_asks_again_and_writes_nothing_down(client: httpx.Client, service: Service, participant: str) -> None:
    model = run_test(client, participant)["model_id"]
    poor = make_poor(service, model)
    with signed_in(service) as browser:
        page = browser.get(f"/models/{poor}?diagnose=0").text
        assert "Approve it all the same" in page and "Test again" in page
        assert not re.search(r">\s*Approve\s*</button>", page), "not by the first button"
        assert browser.get(f"/models/{model}/approve").headers["location"] == f"/models/{model}", "no question needed"
        question = browser.get(f"/models/{poor}/approve")
        assert question.status_code == 200 and "What the controller would risk" in question.text
        assert "the recruitment curve is not identified" in question.text
        assert "the error is 31 % of the torque" in question.text
        again = browser.post(f"/models/{poor}/approve", data={"csrf": csrf(browser), "reason": "ok <b>"})
        assert again.status_code == 422 and "not a reason yet" in again.text and "ok &lt;b&gt;" in again.text
        assert client.get(f"/v1/models/{poor}").json()["decision"] is None
        taken = browser.post(f"/models/{poor}/approve", data={"csrf": csrf(browser), "reason": SOME[0]})
        assert taken.status_code == 303
    approved = client.get(f"/v1/models/{poor}").json()
    assert approved["served"] and approved["decision_reason"] == SOME[0]


# ---- words --------------------------------------------------------------------------------------------------


def test_each_gate_of_identify_has_words() -> None:
    """A new gate without words would be silent on the page."""
    named = set(re.findall(r'"(\w+)": _', inspect.getsource(quality.quality)))
    assert named - {"words"} == set(advice.GATES)


def found(*gates: tuple[str, str]) -> list[advice.Finding]:
    stored = {name: {"passed": False, "severity": severity, "says": name} for name, severity in gates}
    return advice.findings({"quality": {"gates": {"range": {"passed": True}, **stored}}})


@pytest.mark.parametrize(
    ("verdict", "gates", "missing", "act", "words"),
    [
        ("usable", [], [], "approve", "Usable: approve it."),
        ("usable", [], ["Fatigue"], "approve", "Usable: approve it. Fatigue may make it better."),
        ("usable with care", [("ceiling", "care")], [], "approve", "look at where the error sits first"),
        ("usable with care", [("sensor", "care")], [], "approve", "look at the highest torques"),
        ("usable with care", [("gap", "care")], ["Fatigue"], "add", "look at Fatigue first, and add it"),
        ("usable with care", [], [], "approve", "look at where the error sits first"),
        ("not usable", [("torque", "refuse")], [], "test", "test again with electrodes, current and load cell"),
        ("not usable", [("gap", "refuse"), ("range", "care")], ["Fatigue"], "add", "add Fatigue, or test again"),
        ("not usable", [("torque", "refuse"), ("gap", "refuse")], ["Fatigue"], "test", "test again with electrodes"),
        ("not usable", [], [], "test", "test again"),
        ("unknown", [], [], "fit", "There is no verdict"),
    ],
)
def test_the_verdict_says_what_to_do(
    verdict: str, gates: list[tuple[str, str]], missing: list[str], act: str, words: str
) -> None:
    said = advice.advice(verdict, found(*gates), missing)
    assert said.act == act and words in said.words


def test_the_worst_finding_comes_first_and_risks_are_said_once() -> None:
    rows = found(("range", "care"), ("torque", "refuse"), ("sensor", "care"))
    assert [row.gate for row in rows] == ["torque", "range", "sensor"]
    said = advice.risks({"fit": {"held_out_fit_percent": 69.0}}, rows)
    assert any("too wide pulses" in words for words in said) and len(set(said)) == len(said)
    assert said[-1] == "On pulses not used for fitting the error is 31 % of the torque."
    assert advice.risks({}, []), "never nothing"


@pytest.mark.parametrize(
    ("fit", "words"),
    [
        (
            {"held_out_fit_percent": 96.2, "held_out_ceiling_percent": 96.3, "held_out_by": "validate"},
            "On pulses not used for fitting the model follows 96.2 % of the torque; sensor noise limits this to "
            "96.3 %.",
        ),
        ({"held_out_fit_percent": 90.0}, "On pulses not used for fitting the model follows 90.0 % of the torque."),
        (
            {"held_out_fit_percent": 90.0, "held_out_by": "cross-validation"},
            "On parts of the recording that were left out in turn the model follows 90.0 % of the torque.",
        ),
        (
            {"fit_percent": 88.0, "ceiling_percent": 89.0, "held_out_rms_nm": 0.1},
            "On the pulses that it was fitted to the model follows 88.0 % of the torque; sensor noise limits this to "
            "89.0 %.",
        ),
        ({"held_out_fit_percent": -5.0}, "On pulses not used for fitting the model does not follow the torque at all."),
        ({}, ""),
    ],
)
def test_fit_and_ceiling_in_one_sentence(fit: dict[str, Any], words: str) -> None:
    assert advice.fit_sentence(fit) == words


def test_segments_in_a_clinicians_words() -> None:
    from stimrig.api.charts.model_charts import segment_marks
    from stimrig.api.clinical_words import segment_words

    names = ["rest", "prbs", "ramp", "validate", "my <own>"]
    assert [segment_words(name) for name in names] == [
        "Rest", "Random pulses", "Ramp", "Check (not used for fitting)", "my <own>"
    ]  # fmt: skip
    runs = [{"name": name, "start_s": 10.0 * at, "end_s": 10.0 * at + 10.0} for at, name in enumerate(names)]
    marks = segment_marks(runs)[1]
    assert [mark["text"] for mark in marks] == [
        "Random pulses", "Ramp", "Check (not used for fitting)", "my ‹own›"
    ]  # fmt: skip


def test_names_of_short_segments_are_not_written_over_one_another() -> None:
    from stimrig.api.charts.model_charts import LETTER, segment_marks

    ends = [2.7, 3.7, 4.7, 6.7, 8.7, 40.0]
    names = ["opening", "ramp 2", "ramp 3", "step 4", "prbs", "ramp"]
    runs = [{"name": n, "start_s": a, "end_s": b} for n, a, b in zip(names, [0.0, *ends[:-1]], ends, strict=True)]
    shapes, marks = segment_marks(runs)
    assert len(shapes) == len(runs) and 2 <= len(marks) < len(runs)
    places = [(mark["x"], 40.0 * LETTER * len(mark["text"]) / 2) for mark in marks]
    assert all(b - half_b >= a + half_a for (a, half_a), (b, half_b) in itertools.pairwise(places))
