"""One verdict on a model: identify's, the same wherever it is shown."""

from __future__ import annotations

import html
import inspect
import json
import re
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.models import advice, registry, stored_model
from stimrig.identify.estimation import quality
from tests.api.conftest import REAL, Service, run_test, serving
from tests.harness.patients import Patient, make_record
from tests.identify import hidden_muscles


def level_csv(path: Path) -> Path:
    """A made-up record whose held-out torque is level."""
    record, _ = make_record(Patient(), np.random.default_rng(3), rate_hz=100, noise_nm=0.05)
    names = np.array(record.segment_names)[record.segment]
    torque = np.where(names == "validate", 0.25, record.torque_nm)
    rows = zip(record.time_s, record.pulse_width_us, torque, names, strict=True)
    lines = [f"{t:.4f},{u:.3f},{y:.6f},{name}" for t, u, y, name in rows]
    path.write_text("\n".join(["time_s,pulse_width_us,torque_nm,segment", *lines]))
    return path


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert main.run([str(argument) for argument in arguments]) == 0
    return capsys.readouterr().out


@pytest.mark.slow
def test_not_usable_is_said_in_each_place(tmp_path: Path, short_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Level held-out torque has an error and no percent."""
    data, report = level_csv(tmp_path / "record.csv"), tmp_path / "report.html"
    printed = said(capsys, "fit", data, "-o", tmp_path / "MODEL.json")
    document = json.loads((tmp_path / "MODEL.json").read_text())
    stored, fit = document["quality"], document["fit"]
    assert stored["verdict"] == "not usable" and stored["words"].startswith("Do not use this model: ")
    assert f"not usable: {stored['words']}" in printed
    assert fit["held_out_fit_percent"] is fit["held_out_ceiling_percent"] is None
    assert fit["held_out_rms_nm"] > 0 and "whose torque is constant" in stored["words"]
    compared = said(capsys, "compare", tmp_path / "MODEL.json", data, "--html", report)
    assert stored["words"] in compared
    pages = {"report of the command line": report.read_text("utf-8")}
    with serving(tmp_path / "service", short_dir, REAL) as (_, client):
        client.post("/v1/participants", json={"code": "P1"})
        found = client.post("/v1/participants/P1/recordings", content=data.read_bytes(), timeout=200).json()["model"]
        whole = client.get(f"/v1/models/{found['id']}").json()
        for answer in (found, whole, whole["model"]["quality"], *client.get("/v1/participants/P1/models").json()):
            assert {**answer, **{key: stored[key] for key in ("verdict", "words", "reasons")}} == answer
        assert found["held_out_fit_percent"] is None
        for path in (f"/models/{found['id']}?diagnose=0", f"/models/{found['id']}/report"):
            pages[path] = client.get(path).text
        for path in ("/", "/participants/P1"):
            assert '<span class="tag tag-not-usable">not usable</span>' in client.get(path).text, path
    for place, text in pages.items():
        assert "verdict-not-usable" in text, place
        for words in (stored["words"], *stored["reasons"][1:], stored_model.UNDEFINED):
            assert words in html.unescape(text), (place, words)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("usable", "usable with care", "Added without evidence: fatigue, tremor."),
        ("usable with care", "usable with care", "As it was."),
        ("not usable", "not usable", "As it was."),
    ],
)
def test_effects_without_evidence_make_a_verdict_no_better(before: str, after: str, words: str) -> None:
    document = {"quality": {"verdict": before, "words": "As it was.", "reasons": ["a"], "gates": {}}}
    stored_model.mark_without_evidence(document, ["fatigue", "tremor"])
    says = "added without evidence: fatigue, tremor"
    assert stored_model.quality(document) == {"verdict": after, "words": words, "reasons": ["a", says]}
    assert stored_model.without_evidence(document) == ["fatigue", "tremor"]
    assert stored_model.quality({})["verdict"] == "unknown"


# ---- A model that is not usable reaches a controller only with a reason that is one; a usable one with none


NONE = ["", " ", "ok", "......", "xxxxxxxxxxxx", "asdf asdf asdf", "a b c", "aaaa bbbb cccc", "1234 5678 9012",
        "measured twice measured"]  # fmt: skip
SOME = ["only the delay is used today", "Nur die Verzögerung wird heute gebraucht", "plateau measured twice, same"]


def make_poor(service: Service, model: str) -> str:
    """A version of the same recording that identify would call not usable."""
    context = service.context
    row = context.versions.get(model)
    document = json.loads(row.document) | {"model_id": f"M-poor{time.time_ns()}"}
    says = "stimulation hardly changes the torque: check electrodes, current and load cell"
    document["fit"] = document["fit"] | {"held_out_fit_percent": 69.0}
    document["quality"] = {
        "verdict": "not usable", "words": f"Do not use this model: {says}.", "reasons": [says],
        "gates": {"torque": {"passed": False, "severity": "refuse", "says": says}},
    }  # fmt: skip
    return context.versions.add(json.dumps(document), row.participant, row.recording_id, "a test").id


@pytest.mark.parametrize(("text", "holds"), [*((text, False) for text in NONE), *((text, True) for text in SOME)])
def test_what_is_a_reason(text: str, holds: bool) -> None:
    assert registry.is_reason(text) == holds


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


# ---- words --------------------------------------------------------------------------------------------------


def test_each_gate_of_identify_has_words() -> None:
    """A new gate without words would be silent on the page."""
    named = set(re.findall(r'"(\w+)": _', inspect.getsource(quality.quality)))
    assert named - {"words"} == set(advice.GATES) - {"evidence"}  # that one is the service's own


def found(*gates: tuple[str, str]) -> list[advice.Finding]:
    stored = {name: {"passed": False, "severity": severity, "says": name} for name, severity in gates}
    return advice.findings({"quality": {"gates": {"range": {"passed": True}, **stored}}})


FATIGUE, BOTH = ["Fatigue"], ["Fatigue", "Tremor"]


@pytest.mark.parametrize(
    ("verdict", "gates", "missing", "more", "act", "words"),
    [
        ("usable", [], [], {}, "approve", "Usable: approve it."),
        ("usable", [], [], {"kind": "unsure"}, "approve", "this recording cannot tell"),
        ("usable", [], [], {"kind": "unexplained"}, "approve", "that is not explained"),
        ("usable", [], [], {"kind": "missing", "experiment": True}, "approve", "possibly missing"),
        ("usable", [], [], {"diagnosing": True}, "wait", "still being looked for"),
        ("usable", [], FATIGUE, {}, "add", "Usable, and better with “Fatigue”: add that first."),
        ("usable", [], BOTH, {}, "improve", "“Fatigue” and “Tremor”: add that first."),
        ("usable with care", [("ceiling", "care")], [], {}, "approve", "look at where the error sits first"),
        ("usable with care", [("sensor", "care")], [], {}, "approve", "look at the highest torques"),
        ("usable with care", [("gap", "care"), ("evidence", "care")], [], {}, "look", "Compare it with the version"),
        ("usable with care", [("gap", "care")], FATIGUE, {}, "add", "add “Fatigue” first"),
        ("usable with care", [], [], {}, "approve", "look at where the error sits first"),
        ("usable with care", [], [], {"kind": "unsure"}, "approve", "look at where the error sits first"),
        ("usable with care", [], [], {"kind": "unexplained"}, "look", "look at where the error sits first"),
        ("usable with care", [], [], {"kind": "unexplained", "experiment": True}, "experiment", "the next experiment"),
        ("usable with care", [], [], {"kind": None}, "look", "look at where the error sits first"),
        ("usable with care", [], [], {"diagnosing": True}, "wait", "still being looked for"),
        ("not usable", [("torque", "refuse")], [], {}, "test", "test again with electrodes, current and load cell"),
        ("not usable", [("gap", "refuse"), ("range", "care")], FATIGUE, {}, "add", "add “Fatigue”, or test again"),
        ("not usable", [("torque", "refuse"), ("gap", "refuse")], FATIGUE, {}, "test", "test again with electrodes"),
        ("not usable", [], [], {"diagnosing": True}, "test", "test again"),
        ("unknown", [], [], {}, "fit", "There is no verdict"),
    ],
)
def test_verdict_and_diagnosis_give_one_advice(
    verdict: str, gates: list[tuple[str, str]], missing: list[str], more: dict[str, Any], act: str, words: str
) -> None:
    said = advice.advice(verdict, found(*gates), missing, **more)
    assert said.act == act and words in said.words


def test_the_worst_finding_comes_first_and_risks_are_said_once() -> None:
    rows = found(("range", "care"), ("torque", "refuse"), ("sensor", "care"))
    assert [row.gate for row in rows] == ["torque", "range", "sensor"]
    said = advice.risks({"fit": {"held_out_fit_percent": 69.0}}, rows)
    assert any("too wide pulses" in words for words in said) and len(set(said)) == len(said)
    assert said[-1] == "On held-out pulses the error is 31 % of the torque."
    assert advice.risks({}, []), "never nothing"


# ---- A cell mounted the other way round: a told torque is the record's own, or it says that it is the muscle's


PULLS = "as the muscle pulls"


def drifting(sign: int) -> identify.Record:
    """Downward by 0.03 N·m/s where the cell is inverted, from a baseline on the same side."""
    record = hidden_muscles.record("baseline_drift", seed=5)
    return record.with_torque(sign * (record.torque_nm + 0.5))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_torque_told_of_an_effect_says_when_it_counts_as_the_muscle_pulls(sign: int) -> None:
    record = drifting(sign)
    model = identify.fit(record, effects=["baseline_drift:linear"])
    slope = model.effects[0]["parameters"]["slope_nm_per_s"]
    assert slope["value"] == pytest.approx(0.03, abs=0.01) and np.sign(model.baseline_nm) == sign
    assert slope.get("direction") == (None if sign > 0 else PULLS) and (f"N·m/s {PULLS}" in str(model)) == (sign < 0)
    humming = record.with_torque(record.torque_nm + 0.3 * np.sin(2 * np.pi * 50.0 * record.time_s))
    hum = identify.fit(humming, effects=["mains_hum"]).effects[0]["parameters"]["sin_1_nm"]
    assert hum["value"] == pytest.approx(0.3, abs=0.02) and "direction" not in hum, "a number of the sensor"


def test_threshold_plateau_and_validity_are_those_of_the_same_cell_mounted_upright() -> None:
    record = hidden_muscles.record("fatigue", seed=5)
    upright, inverted = (identify.fit(record.with_torque(12 + sign * record.torque_nm)).to_dict() for sign in (1, -1))
    one, other = stored_model.recruitment(upright), stored_model.recruitment(inverted)
    assert one["threshold_us"] == pytest.approx(other["threshold_us"], abs=1)
    assert one["saturation_us"] == pytest.approx(other["saturation_us"], abs=1)
    assert other["plateau_nm"] == pytest.approx(-(one["plateau_nm"] or 0.0), rel=0.01)
    assert "torques up to" in str(stored_model.validity(upright))
    assert "torques down to -" in str(stored_model.validity(inverted))
