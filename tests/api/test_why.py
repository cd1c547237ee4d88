"""Where a model fails, what it lacks, adding that, the next experiment; progress and cancelling."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import httpx
import jsonschema_rs
import pytest

from bench.muscles import hidden_records
from stimrig import identify
from stimrig.api import record_files, schemas
from stimrig.api.jobs import verbs
from stimrig.api.jobs.curves import comparison
from stimrig.api.models import explanation
from stimrig.api.web.pages.report_file import missing_parts
from stimrig.identify.conclusion import conclude, why_ended
from tests.api.conftest import Service, run_test, signed_in, soon, wait_done
from tests.api.fake_rig import write_recording
from tests.harness import few_effects

pytestmark = pytest.mark.slow


@pytest.fixture
def model(client: httpx.Client, participant: str) -> str:
    """The model of a test."""
    return run_test(client, participant)["model_id"]


def make_slow(service: Service, progress: float = 0.5) -> Path:
    """Diagnoses stand still for a minute from now on, this far; who asks waits for those that are half done."""
    marker = service.data / "recordings" / "slow"
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.write_text(str(progress))
    return marker


# ---- long work ----------------------------------------------------------------------------------------------


def test_job_reports_progress_and_can_be_cancelled(client: httpx.Client, service: Service, participant: str) -> None:
    make_slow(service)
    model = run_test(client, participant)["model_id"]
    with signed_in(service) as browser:
        url = re.findall(r'data-call="DELETE (/v1/jobs/\w+)"', browser.get(f"/models/{model}").text)[0]
        begun = client.get(f"/v1/models/{model}/diagnosis?wait=false")
        assert begun.status_code == 202 and begun.headers["location"] == url, "the job of the first asker"
        job = soon(lambda: (found := client.get(url).json())["progress"] == 0.5 and found)
        assert job["state"] == "running" and job["time_left_s"] is not None and job["text"] == "tried fatigue"
        ended = client.delete(url).json()
        assert ended["state"] == "cancelled" and ended["problem"]["title"] == "The job was cancelled"
        page = browser.get(f"/models/{model}").text
        assert "Diagnose now" in page and "data-job" not in page
    assert client.get("/v1/jobs/J999").status_code == 404


def test_a_job_is_shared_by_equal_requests_alone(client: httpx.Client, service: Service, participant: str) -> None:
    model = run_test(client, participant)["model_id"]
    make_slow(service)
    urls = [
        client.post(f"/v1/models/{model}/effects?wait=false", json={"effects": [effect]}).headers["location"]
        for effect in ("fatigue", "fatigue", "tremor")
    ]
    assert urls[0] == urls[1] != urls[2]


def test_pages_of_jobs_lead_to_the_result_or_say_why_there_is_none(
    client: httpx.Client, pages: httpx.Client, model: str
) -> None:
    def ended(ask: str, body: dict[str, Any]) -> tuple[dict[str, Any], httpx.Response]:
        url = client.post(f"/v1/models/{model}/{ask}?wait=false", json=body).headers["location"]
        job = soon(lambda: (found := client.get(url).json())["done"] and found)
        return job, pages.get(url.removeprefix("/v1"))

    job, page = ended("improve", {})
    assert page.status_code == 303 and page.headers["location"] == job["result_url"].removeprefix("/v1")
    better = client.get(job["result_url"]).json()
    assert (better["effects"], better["parent_id"], better["added_effect"]) == (["fatigue"], model, "fatigue")
    assert better["model"]["extra"]["parent"] == model
    again = client.post(f"/v1/models/{model}/improve")
    assert again.status_code == 201 and again.headers["location"] == f"/v1/models/{better['id']}"
    assert [version["id"] for version in again.json()["versions"]] == [model, better["id"]], "a version a step"
    _, page = ended("effects", {"effects": ["tremor"]})
    assert page.status_code == 409
    assert "gives no evidence for this effect" in page.text and "Back to the model" in page.text


# ---- effects ------------------------------------------------------------------------------------------------


def test_effect_without_evidence_needs_force_and_a_reason_and_is_marked(
    pages: httpx.Client, client: httpx.Client, model: str
) -> None:
    def add(to: str, *effects: str, **more: Any) -> httpx.Response:
        return client.post(f"/v1/models/{to}/effects", json={"effects": effects, **more})

    because = {"force": True, "reason": "seen with the eye"}
    refused = add(model, "tremor")
    assert refused.status_code == 409 and refused.json()["type"] == "/problems/effect-not-there"
    assert "log evidence changes by -4.0" in refused.json()["reasons"]["tremor"]
    silent = add(model, "tremor", force=True)
    assert silent.status_code == 422 and "Give a reason" in silent.json()["detail"]
    forced = add(model, "tremor", **because).json()
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "force effect"]
    assert [entry["detail"]["reason"] for entry in entries] == ["seen with the eye"]
    assert (forced["effects"], forced["without_evidence"]) == (["tremor"], ["tremor"])
    stored = client.get(f"/v1/models/{forced['id']}").json()["model"]["quality"]
    assert stored["verdict"] == "usable with care" and not stored["gates"]["evidence"]["passed"]
    assert add(model, "fatigue", **because).json()["without_evidence"] == [], "the recording asks for it"
    later = add(forced["id"], "fatigue", **because).json()
    assert later["without_evidence"][0] == "tremor", "a later version still holds it"
    at = f"/models/{forced['id']}"
    assert "It holds an effect that was added without evidence" in pages.get(at).text
    client.post(f"/v1{at}/approve")
    for path in ("/participants/P017", "/participants/P017/trend", at, f"{at}/report"):
        assert "tremor (without evidence)" in pages.get(path).text, path


def test_an_effect_added_before_anybody_had_looked_is_not_marked_for_good(
    client: httpx.Client, service: Service, participant: str
) -> None:
    marker = make_slow(service, 0.2)  # not half done: a later request does not wait for it
    model = run_test(client, participant)["model_id"]
    body = {"effects": ["fatigue", "fatigue"], "force": True, "reason": "seen with the eye"}
    hasty = client.post(f"/v1/models/{model}/effects", json=body).json()
    assert hasty["without_evidence"] == ["fatigue"] and hasty["added_effect"] == "fatigue"
    marker.unlink()
    asked = client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()
    assert asked["id"] != hasty["id"] and asked["without_evidence"] == []
    assert client.post(f"/v1/models/{model}/improve").json()["versions"][-1]["id"] == asked["id"]


def test_version_with_effects_is_criticised_with_them(client: httpx.Client, pages: httpx.Client, model: str) -> None:
    better = client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()["id"]
    plain, own = (client.get(f"/v1/models/{name}/diagnosis").json() for name in (model, better))
    assert (plain["structure"], [entry["effect"] for entry in plain["missing"]]) == ([], ["fatigue"])
    assert (own["structure"], [entry["effect"] for entry in own["missing"]]) == (["fatigue"], ["threshold_drift"])
    page = pages.get(f"/models/{better}").text
    assert "Structure of the model: fatigue" in page and 'id="effect-threshold_drift"' in page
    assert 'id="effect-fatigue"' not in page
    assert f'data-next="/models/{model}#versions"' in page and "Undo: back to the previous version" in page
    assert "Undo" not in pages.get(f"/models/{model}").text
    rows = client.post(f"/v1/models/{better}/improve").json()["versions"]
    assert rows[0]["id"] == better and rows[-1]["parent_id"] == better
    assert rows[-1]["effects"] == ["fatigue", "threshold_drift"]


def test_reasons_against_an_effect() -> None:
    fatigue, against = {"effect": "fatigue", "confused_with": ["drift"]}, "The evidence is against it."
    free = [{"effect": "free_width_by_rise"}]
    found = {"missing": [fatigue], "free": free, "refused": [{"effect": "tremor", "reason": against}]}
    asked = [
        "fatigue",
        "drift",
        "free_width_by_rise",
        "tremor",
        "torque_angle",
    ]  # drift cannot be told apart from fatigue
    assert explanation.refusals(found, asked) == {"tremor": against, "torque_angle": explanation.NOT_TESTED}
    objected = {**FATIGUE, "objection": "On held-out pulses the error would rise."}
    assert explanation.refusals({"missing": [objected]}, ["fatigue"]) == {"fatigue": objected["objection"]}


# ---- the next experiment ------------------------------------------------------------------------------------


def test_next_experiment_is_played_and_joined(client: httpx.Client, service: Service, model: str) -> None:
    experiment = client.get(f"/v1/models/{model}/diagnosis").json()["experiment"]
    body = {"participant": "P017", "kind": "next-experiment", "segments": experiment["segments"], "joins": model}
    started = client.post("/v1/tests", json=body)
    assert started.status_code == 202, started.text
    document = wait_done(client, started.json()["id"])
    assert document["state"] == "completed" and document["joins"] == model
    new = client.get(document["model_url"]).json()
    assert new["parent_id"] == model and new["recording_id"].startswith("joined-")
    assert service.context.versions.why_not_joined(service.context.versions.get(new["id"])) == "", "a third can follow"
    parts = client.get(f"/v1/recordings/{new['recording_id']}").text.splitlines()
    old = client.get(f"/v1/models/{model}").json()["recording_id"]
    assert [Path(part).stem for part in parts] == [old, document["recording_id"]]
    assert service.rig.starts == 2


def test_experiment_joins_only_the_participants_own_model(client: httpx.Client, service: Service, model: str) -> None:
    client.post("/v1/participants", json={"code": "P2"})
    refused = client.post("/v1/tests", json={"participant": "P2", "joins": model})
    assert refused.status_code == 422 and "P017" in refused.json()["detail"]
    assert client.post("/v1/tests", json={"participant": "P017", "joins": "nothing"}).status_code == 404
    assert service.rig.starts == 1 and client.get("/v1/rig").json()["holder"] is None


def test_worker_joins_by_begin_and_leaves_a_file_with_the_parts(tmp_path: Path) -> None:
    widths = [200.0 if index >= 40 and index // 20 % 2 else 0.0 for index in range(240)]
    segments = [{"name": "rest", "start_s": 0.0, "end_s": 1.0}, {"name": "steps", "start_s": 1.0, "end_s": 6.0}]
    paths = []
    for name, rate_hz, minute in (("late", 400, 10), ("early", 1600, 0)):
        torque = [widths[int(index * 40 / rate_hz)] / 40 for index in range(6 * rate_hz)]
        plan: Any = SimpleNamespace(test_id=name, participant="P017", kind="default")
        path, _ = write_recording(tmp_path, plan, widths, torque, segments, rate_hz, "completed")
        with h5py.File(path, "r+") as file:
            file.attrs["created_utc"] = f"2026-01-01T00:{minute:02d}:00.250Z"
        paths.append(str(path))
    out = tmp_path / "joined.csv"
    found = record_files.joined(paths, str(out), lambda *_: None)
    assert found["file_sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    joined = identify.read(out)
    assert [source.recording_id for source in joined.source.parts] == ["R-early", "R-late"]
    assert joined.sample_rate_hz == pytest.approx(400, abs=0.01)
    assert joined.parts[1].pause_s == pytest.approx(594.0, abs=0.03) and joined.parts[1].folded_s == 5.0
    assert joined.parts[0].begun_s == pytest.approx(1767225600.25)


# ---- words of a diagnosis -----------------------------------------------------------------------------------

WORDS = "falling ramp, 120-180 µs: model too high by 0.4 N·m"
PLACE = {
    "segment": "ramp", "start_s": 1.0, "end_s": 2.0, "pulse_width_us": [120, 180], "share_of_excess": 0.31,
    "direction": "falling", "text": f"{WORDS}, 31 % of the error above the noise",
}  # fmt: skip
FATIGUE = {"effect": "fatigue", "name": "Fatigue", "probability": 0.97, "rms_before_nm": 0.2, "rms_after_nm": 0.05}
NOTHING = {"verdict": "nothing_missing", "missing": [], "noise_sd_nm": 0.04, "where": [PLACE]}
MISSING = {"verdict": "effect_missing", "missing": [FATIGUE], "noise_sd_nm": 0.04}
PART = {"verdict": "unexplained_structure", "missing": [{**FATIGUE, "probability": 0.45}], "noise_sd_nm": 0.04}
FREE = {"effect": "free_width_by_rise", "name": "Free level", "words": "", "parameters": {}}
PLAN = {"deciding_experiment": {"text": "x"}}


@pytest.mark.parametrize(
    ("more", "kind"),
    [
        ({}, "nothing"),
        ({"residual_check": False}, "unsure"),
        ({"base": {"held_out_rms_nm": 0.12}}, "unsure"),
        ({"probability": 0.3, "candidates": [[{"effect": "tremor", "log_evidence_gain": 30.0}]]}, "unsure"),
    ],
)
def test_what_may_be_more_than_noise_is_not_called_noise(more: dict[str, Any], kind: str) -> None:
    diagnosis = NOTHING | {"where": []} | more
    assert explanation.view(diagnosis, {"noise_sd_nm": 0.04, "rms_nm": 0.04})["kind"] == kind
    assert ("left is noise" in conclude(diagnosis).title) == (kind == "nothing")


@pytest.mark.parametrize(
    ("diagnosis", "title", "advice", "ended"),
    [
        (PART | {"add": ["fatigue"]}, "explain a part of the error only", "Add “Fatigue”: it explains a part.",
         "More can be learnt from this record."),
        (PART | {"add": ["fatigue", "free_width_by_rise"], "free": [FREE]} | PLAN, "a part of the error only",
         "Add “Fatigue”: it explains a part. Add “Free level”: it describes what is left, and names no cause. "
         "The next experiment teaches most about it.", "More"),
        (PART | {"missing": [], "add": ["a", "b"], "free": [FREE, FREE]}, "structure that no effect",
         "Add “Free level” and “Free level”: they describe what is left, and name no cause.", "More"),
        (PART | {"add": ["fatigue"]} | PLAN, "a part of the error only",
         "Add “Fatigue”: it explains a part. Play the next experiment: it teaches most about what is left.", "More"),
        (PART | {"add": []}, "structure that no effect of the library explains",
         "Look at the worst places and at electrodes, load cell and fixture, and record again.",
         "Nothing more can be learnt from this record alone."),
        (MISSING | {"add": [], "missing": [{**FATIGUE, "next_experiment": "The ramp again."}]}, "An effect is missing",
         "Add nothing yet: held-out pulses speak against adding any. The ramp again.", "Nothing more can be learnt"),
    ],
)  # fmt: skip
def test_a_conclusion_advises_what_the_diagnosis_asks_for(
    diagnosis: dict[str, Any], title: str, advice: str, ended: str
) -> None:
    said = conclude(diagnosis)
    assert title in said.title and said.advice == advice and why_ended(diagnosis).startswith(ended)


def test_effects_are_shown_in_the_order_of_improve_and_only_the_likely_are_advised() -> None:
    rows = [{**FATIGUE, "effect": name, "name": name.title()} for name in ("tremor", "fatigue", "potentiation")]
    view = explanation.view(MISSING | {"missing": rows, "add": ["fatigue", "tremor"]}, None)
    assert [entry["id"] for entry in view["missing"]] == ["fatigue", "tremor", "potentiation"]
    assert view["advice"] == "Add “Fatigue”, then “Tremor” to the model."
    perhaps = {**rows[0], "probability": 0.45}
    both, alone = (explanation.view(MISSING | {"missing": rows}, None) for rows in ([FATIGUE, perhaps], [perhaps]))
    assert both["likely"] == ["Fatigue"] and both["title"] == "An effect is missing in this model"
    assert alone["likely"] == [] and "possibly missing" in alone["title"] and len(alone["missing"]) == 1


def test_an_added_effect_has_the_form_that_was_found(
    client: httpx.Client, service: Service, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    analyses, pool = service.context.analyses, service.context.pool
    client.get(f"/v1/models/{model}/diagnosis")
    free = {"effect": "fatigue", "form": "fitness", "name": "Fatigue", "words": "", "parameters": {}}
    two = {**MISSING, "missing": [{**FATIGUE, "effect": "tremor"}], "free": [free], "add": ["tremor", "fatigue"]}
    analyses._store_result(model, "diagnosis", {**two, "improvement": {"steps": [], "models": []}})
    submit, submitted = pool.submit, []
    monkeypatch.setattr(pool, "submit", lambda *verb, **how: (submitted.append((*verb, how)), submit(*verb, **how))[1])
    body = {"effects": ["fatigue"], "force": True, "reason": "seen with the eye"}
    child = client.post(f"/v1/models/{model}/effects", json=body).json()
    assert child["without_evidence"] == [], "the recording asks for it"
    assert [how["effects"] for verb, how in submitted if verb == "fit"] == [["fatigue:fitness"]]
    told = client.get(f"/v1/models/{child['id']}/diagnosis").json()
    assert told["structure"] == ["fatigue"] and submitted[-1][0] == "diagnosis", "its search contains no such model"


def test_what_a_search_contains_is_neither_fitted_nor_searched_again(
    client: httpx.Client, service: Service, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    analyses = service.context.analyses
    first = client.get(f"/v1/models/{model}/diagnosis").json()
    models = analyses.known(model, "improvement of diagnosis")["models"]
    left = {**first, "structure": ["fatigue"], "missing": [], "verdict": "nothing_missing"}
    improvement = {"steps": [], "models": models}
    analyses._store_result(model, "diagnosis", {"rows": [first, left], "improvement": improvement})
    submit, submitted = service.context.pool.submit, []
    monkeypatch.setattr(
        service.context.pool, "submit", lambda verb, **how: (submitted.append(verb), submit(verb, **how))[1]
    )
    child = client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()
    assert child["id"] == models[1]["model_id"]
    assert client.get(f"/v1/models/{child['id']}/diagnosis").json()["verdict"] == "nothing_missing"
    assert client.get(f"/v1/models/{model}/diagnosis").json()["structure"] == []
    assert {*submitted} <= {"effects"}


def test_one_search_serves_two_versions_of_the_same_structure(
    client: httpx.Client, service: Service, model: str
) -> None:
    """Its models are stored once for each line of descent, and none is taken for another."""
    client.get(f"/v1/models/{model}/diagnosis")
    versions = service.context.versions
    first = versions.get(model)
    twin = versions.add(
        json.dumps({**json.loads(first.document), "model_id": "twin"}), first.participant, first.recording_id, "Ada"
    )
    body = {"effects": ["fatigue"]}
    one, other = (client.post(f"/v1/models/{name}/effects", json=body).json() for name in (model, twin.id))
    assert (one["parent_id"], other["parent_id"]) == (model, "twin") and one["id"] != other["id"]


def test_free_effects_are_added_together_and_shown_with_their_common_error(
    client: httpx.Client, pages: httpx.Client, service: Service, model: str
) -> None:
    client.get(f"/v1/models/{model}/diagnosis")
    law = {"lines": {}, "at": [0.0, 0.5], "driver": "torque (N·m)", "axis": "opening (1)"}
    free = [FREE | law, {**FREE, **law, "effect": "free_strength_by_torque", "name": "Free strength"}]
    with_all = {"rms_nm": 0.111, "held_out_rms_nm": 0.123}
    found = NOTHING | {"verdict": "unexplained_structure", "free": free, "with_all": with_all}
    service.context.analyses._store_result(model, "diagnosis", found)
    shown = pages.get(f"/models/{model}").text
    assert shown.count('value="free_width_by_rise free_strength_by_torque"') == 2 and "Add this effect" not in shown
    assert all(words in shown for words in ("With all that is added", "≈ 0.111", "≈ 0.123"))


def test_places_are_shown_where_something_is_left() -> None:
    rows = [{"label": "ramp", "share_of_excess": 1.0}]
    comparison = {"noise_sd_nm": 0.04, "rms_nm": 0.04, "where": [PLACE], "by": {"segment": rows}}
    for check, count in ((True, 0), (False, 1)):
        shown = missing_parts(explanation.view(NOTHING | {"residual_check": check}, comparison), comparison)
        assert len(shown["places"]) == len(shown["splits"]) == count
        before = missing_parts(None, {**comparison, "tests": {"tests": [{"passed": check}]}})
        assert len(before["places"]) == count, "before a diagnosis is there"


def test_an_error_that_is_shown_of_a_model_is_its_own() -> None:
    """A second effect is fitted beside the first: its error without itself is not that of the model on the page."""
    first = {**FATIGUE, "held_out_rms_before_nm": 0.056, "held_out_rms_after_nm": 0.05}
    second = {**FATIGUE, "effect": "tremor", "held_out_rms_before_nm": 0.102, "held_out_rms_after_nm": 0.057}
    base = {"held_out_rms_nm": 0.0555, "rms_nm": 0.2}
    view = explanation.view(MISSING | {"missing": [first, second], "base": base, "add": []}, None)
    assert [error[1] for error in view["missing"][0]["errors"]] == [0.2, 0.056]
    assert [error[1] for error in view["missing"][1]["errors"]] == [0.2] and view["to_add"] == []


def test_a_model_on_another_recording(client: httpx.Client, model: str, participant: str) -> None:
    other = run_test(client, participant)["model_id"]
    recording = client.get(f"/v1/models/{other}").json()["recording_id"]
    for name, status in ((recording, 200), ("none", 404)):
        assert client.get(f"/v1/models/{model}/comparison", params={"recording": name}).status_code == status


def test_real_worker_finds_what_is_missing_and_the_page_shows_it(tmp_path: Path) -> None:
    """identify's own answers carry what page and routes build on."""
    path = str(tmp_path / "record.csv")
    hidden_records.write_csv(hidden_records.generate("asymmetric_relaxation", "middle", 8, rate_hz=100), path)
    told: list[float] = []
    with few_effects.only("asymmetric_relaxation", "fatigue", "recruitment_hysteresis", "potentiation"):
        (found, left) = verbs.diagnosis(path, lambda share, _text="": told.append(share))["rows"]
    assert (left["structure"], left["verdict"]) == (["asymmetric_relaxation:slow_lag"], "nothing_missing")
    assert list(jsonschema_rs.validator_for(schemas.load("diagnosis")).iter_errors(found)) == []
    assert told == sorted(told) and told[-1] <= 1 and len(told) >= 4
    assert (found["structure"], found["verdict"]) == ([], "effect_missing")
    assert [entry["effect"] for entry in found["missing"]] == ["asymmetric_relaxation"]
    model = verbs.fit(path, lambda *_: None)
    compared = comparison(path, lambda *_: None, model["json"])
    assert list(jsonschema_rs.validator_for(schemas.load("comparison")).iter_errors(compared)) == []
    assert 1000 < len(compared["series"]["time_s"]) <= 2400
    view = explanation.view(found, compared)
    assert [entry["effect"] for entry in view["missing"]] == ["asymmetric_relaxation"]
    assert {split["title"] for split in explanation.splits(compared)} == {*explanation.SPLITS.values()}
