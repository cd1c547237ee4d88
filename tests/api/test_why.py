"""Where a model fails, what it lacks, adding that, undoing it, the next experiment; progress and cancelling."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import httpx
import pytest

from bench.muscles import hidden_records
from stimrig.api.errors import ApiError
from stimrig.api.models import explanation
from stimrig.api.web.pages.report_file import missing_parts
from stimrig.identify.conclusion import conclude, why_ended
from tests.api.conftest import Service, run_test, signed_in, soon, wait_done
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


def test_new_test_ends_the_diagnosis_in_the_background(client: httpx.Client, service: Service, participant: str):
    make_slow(service)
    model = run_test(client, participant)["model_id"]
    analyses = service.context.analyses
    job = soon(lambda: analyses.running.get((model, "diagnosis")))
    soon(lambda: job.state == "running")
    assert client.post("/v1/tests", json={"participant": participant}).status_code == 202
    soon(lambda: job.state == "cancelled")
    assert analyses.known(model, "diagnosis") is None


def test_who_asks_does_not_wait_for_low_priority(client: httpx.Client, service: Service, participant: str) -> None:
    marker = make_slow(service, 0.2)
    model = run_test(client, participant)["model_id"]
    analyses = service.context.analyses
    soon(lambda: (job := analyses.running.get((model, "diagnosis"))) and job.background and job.progress > 0.1)
    marker.unlink()
    assert client.get(f"/v1/models/{model}/diagnosis").json()["verdict"] == "effect_missing"


def test_job_tells_how_far_it_is_and_can_be_cancelled(client: httpx.Client, service: Service, model: str) -> None:
    soon(lambda: service.context.analyses.known(model, "diagnosis"))
    body = {"effects": ["slow"], "force": True, "reason": "x"}
    begun, again = (client.post(f"/v1/models/{model}/effects?wait=false", json=body) for _ in range(2))
    url = begun.headers["location"]
    assert begun.status_code == 202 and again.headers["location"] == url
    job = soon(lambda: (found := client.get(url).json())["progress"] == 0.5 and found)
    assert job["state"] == "running" and job["time_left_s"] is not None and job["text"] == "identifying"
    ended = client.delete(url).json()
    assert ended["state"] == "cancelled" and ended["problem"]["title"] == "The job was cancelled"
    assert len(client.get("/v1/participants/P017/models").json()) == 1
    assert client.get("/v1/jobs/J999").status_code == 404


def test_job_leads_to_its_result(client: httpx.Client, model: str) -> None:
    begun = client.post(f"/v1/models/{model}/improve?wait=false")
    assert begun.status_code == 202
    job = soon(lambda: (found := client.get(begun.headers["location"]).json())["done"] and found)
    assert job["state"] == "completed" and job["progress"] == 1.0
    assert client.get(job["result_url"]).json()["effects"] == ["fatigue"]


# ---- effects ------------------------------------------------------------------------------------------------


def test_effect_that_is_not_there_is_refused_with_the_reason(
    service: Service, client: httpx.Client, model: str
) -> None:
    refused = client.post(f"/v1/models/{model}/effects", json={"effects": ["tremor"]})
    assert refused.status_code == 409 and refused.json()["type"] == "/problems/effect-not-there"
    assert "log evidence changes by -4.0" in refused.json()["reasons"]["tremor"]
    silent = client.post(f"/v1/models/{model}/effects", json={"effects": ["tremor"], "force": True})
    assert silent.status_code == 422 and "Give a reason" in silent.json()["detail"]
    body = {"effects": ["tremor"], "force": True, "reason": "seen with the eye"}
    forced = client.post(f"/v1/models/{model}/effects", json=body)
    assert forced.status_code == 201 and forced.json()["effects"] == ["tremor"]
    entries = [entry for entry in client.get("/v1/audit").json()["entries"] if entry["action"] == "force effect"]
    assert [entry["detail"]["reason"] for entry in entries] == ["seen with the eye"]
    assert forced.json()["without_evidence"] == ["tremor"] and forced.json()["verdict"] == "usable with care"
    stored = client.get(f"/v1/models/{forced.json()['id']}").json()["model"]["quality"]
    assert stored["verdict"] == "usable with care" and not stored["gates"]["evidence"]["passed"]
    with signed_in(service) as page:
        html = page.get(f"/models/{forced.json()['id']}").text
    assert "It holds an effect that was added without evidence" in html and "(without evidence)" in html
    body |= {"effects": ["fatigue"]}  # the recording asks for it: to force it changes nothing
    asked = client.post(f"/v1/models/{model}/effects", json=body)
    assert asked.json()["without_evidence"] == []
    with signed_in(service) as page:
        client.post(f"/v1/models/{forced.json()['id']}/approve")
        beside = f"/compare?model={model}&model={forced.json()['id']}"
        for path in ("/participants/P017", "/participants/P017/trend", beside):
            assert "tremor (without evidence)" in page.get(path).text, path
        for path in (f"/models/{forced.json()['id']}", f"/models/{forced.json()['id']}/report"):
            assert "with tremor (without evidence)" in page.get(path).text, path
    both = client.post(f"/v1/models/{forced.json()['id']}/effects", json=body)
    assert both.json()["without_evidence"][0] == "tremor", "a later version still holds it"


def test_an_effect_added_before_anybody_had_looked_is_not_marked_for_good(
    client: httpx.Client, service: Service, participant: str
) -> None:
    marker = make_slow(service, 0.2)  # not half done: who asks later does not wait for it
    model = run_test(client, participant)["model_id"]
    body = {"effects": ["fatigue", "fatigue"], "force": True, "reason": "seen with the eye"}
    hasty = client.post(f"/v1/models/{model}/effects", json=body).json()
    assert hasty["without_evidence"] == ["fatigue"] and hasty["added_effect"] == "fatigue"
    marker.unlink()
    asked = client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()
    assert asked["id"] != hasty["id"] and asked["without_evidence"] == []
    assert client.post(f"/v1/models/{model}/improve").json()["versions"][-1]["id"] == asked["id"]


def test_improve_makes_a_version_a_step_and_undo_goes_back(client: httpx.Client, model: str) -> None:
    done = client.post(f"/v1/models/{model}/improve")
    assert done.status_code == 201, done.text
    versions = done.json()["versions"]
    assert [version["added_effect"] for version in versions] == [None, "fatigue"]
    better = versions[-1]["id"]
    assert versions[-1]["parent_id"] == model and done.headers["location"] == f"/v1/models/{better}"
    assert client.get(f"/v1/models/{better}").json()["model"]["extra"]["parent"] == model
    assert client.post(f"/v1/models/{model}/improve").json()["versions"][-1]["id"] == better
    client.post(f"/v1/models/{better}/approve")
    assert client.post(f"/v1/models/{better}/undo", json={"reason": "not plausible"}).json()["id"] == model
    assert client.get("/v1/participants/P017/model").json()["model_id"] == model
    assert client.get(f"/v1/models/{better}").json()["decision"] == "rejected"
    assert client.post(f"/v1/models/{model}/undo").json()["detail"].endswith("Reject it instead.")
    client.post(f"/v1/models/{model}/reject").raise_for_status()
    refused = client.post(f"/v1/models/{model}/undo")
    assert refused.status_code == 409 and "it is rejected. Approve it anew" in refused.json()["detail"]


def test_undo_of_what_was_not_in_use_approves_nothing(client: httpx.Client, model: str) -> None:
    better = client.post(f"/v1/models/{model}/improve").json()["versions"][-1]["id"]
    client.post(f"/v1/models/{better}/undo")
    assert client.get("/v1/participants/P017/model").status_code == 404


# ---- a version's own structure ------------------------------------------------------------------------------


def with_fatigue(client: httpx.Client, model: str) -> str:
    return client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()["id"]


def test_version_with_effects_is_criticised_with_them(client: httpx.Client, pages: httpx.Client, model: str) -> None:
    better = with_fatigue(client, model)
    plain, own = (client.get(f"/v1/models/{name}/diagnosis").json() for name in (model, better))
    assert (plain["structure"], [entry["effect"] for entry in plain["missing"]]) == ([], ["fatigue"])
    assert (own["structure"], [entry["effect"] for entry in own["missing"]]) == (["fatigue"], ["threshold_drift"])
    page = pages.get(f"/models/{better}").text
    assert "Structure of the model: fatigue" in page and 'id="effect-threshold_drift"' in page
    assert 'id="effect-fatigue"' not in page
    assert "Structure of the model: plain" in pages.get(f"/models/{model}").text
    added = client.post(f"/v1/models/{better}/effects", json={"effects": ["threshold_drift"]})
    assert added.status_code == 201 and added.json()["effects"] == ["fatigue", "threshold_drift"]


def test_improving_a_version_adds_to_what_it_holds(client: httpx.Client, model: str) -> None:
    better = with_fatigue(client, model)
    rows = client.post(f"/v1/models/{better}/improve").json()["versions"]
    assert rows[0]["id"] == better and rows[-1]["parent_id"] == better
    assert rows[-1]["effects"] == ["fatigue", "threshold_drift"]


def test_reasons_against_an_effect() -> None:
    fatigue, against = {"effect": "fatigue", "confused_with": ["drift"]}, "The evidence is against it."
    free = [{"effect": "free_level"}]
    found = {"missing": [fatigue], "free": free, "refused": [{"effect": "tremor", "reason": against}]}
    asked = ["fatigue", "drift", "free_level", "tremor", "torque_angle"]  # drift cannot be told apart from fatigue
    assert explanation.refusals(found, asked) == {"tremor": against, "torque_angle": explanation.NOT_TESTED}


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
    from stimrig import identify
    from stimrig.api import record_files
    from tests.api.fake_rig import write_recording

    widths = [200.0 if index >= 40 and index // 20 % 2 else 0.0 for index in range(240)]
    segments = [{"name": "rest", "start_s": 0.0, "end_s": 1.0}, {"name": "steps", "start_s": 1.0, "end_s": 6.0}]
    paths = []
    for name, rate_hz, minute in (("late", 400, 10), ("early", 1600, 0)):
        torque = [widths[int(index * 40 / rate_hz)] / 40 for index in range(6 * rate_hz)]
        plan = SimpleNamespace(test_id=name, participant="P017", kind="default")
        path, _ = write_recording(tmp_path, plan, widths, torque, segments, rate_hz, "completed")  # pyright: ignore[reportArgumentType]
        with h5py.File(path, "r+") as file:
            file.attrs["created_utc"] = f"2026-01-01T00:{minute:02d}:00.250Z"
        paths.append(str(path))
    out, exported = tmp_path / "joined.csv", tmp_path / "exported.csv"
    found = record_files.joined(paths, str(out), lambda *_: None)
    assert found["file_sha256"] == hashlib.sha256(out.read_bytes()).hexdigest()
    joined = identify.read(out)
    assert [source.recording_id for source in joined.source.parts] == ["R-early", "R-late"]
    assert joined.sample_rate_hz == pytest.approx(400, abs=0.01)
    assert joined.parts[1].pause_s == pytest.approx(594.0, abs=0.03) and joined.parts[1].folded_s == 30.0
    assert joined.parts[0].begun_s == pytest.approx(1767225600.25)
    # Torque that follows at once is no second order: its zero is found to a fiftieth of its 5 N·m.
    assert identify.fit(joined).baseline_nm == pytest.approx(0.0, abs=0.1)
    record_files.joined(paths[::-1], str(exported), lambda *_: None)
    assert exported.read_bytes() == out.read_bytes()
    record_files.export_csv(str(out), lambda *_: None, str(exported))
    assert identify.read(exported).parts == joined.parts


# ---- what the page says -------------------------------------------------------------------------------------

WORDS = "falling ramp, 120-180 µs: model too high by 0.4 N·m"
PLACE = {
    "segment": "ramp", "start_s": 1.0, "end_s": 2.0, "pulse_width_us": [120, 180], "share_of_excess": 0.31,
    "direction": "falling", "text": f"{WORDS}, 31 % of the error above the noise",
}  # fmt: skip
FATIGUE = {"effect": "fatigue", "name": "Fatigue", "probability": 0.97, "rms_before_nm": 0.2, "rms_after_nm": 0.05}


def shown(verdict: str, missing: list[dict[str, Any]], times: float) -> dict[str, Any]:
    diagnosis = {"verdict": verdict, "missing": missing, "where": [PLACE], "noise_sd_nm": 0.04}
    return explanation.view(diagnosis, {"noise_sd_nm": 0.04, "rms_nm": 0.04 * times})


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
    diagnosis = {"verdict": "nothing_missing", "missing": [], "noise_sd_nm": 0.04, "where": [], **more}
    assert explanation.view(diagnosis, {"noise_sd_nm": 0.04, "rms_nm": 0.04})["kind"] == kind
    assert ("left is noise" in conclude(diagnosis).title) == (kind == "nothing")


def test_effects_are_advised_in_the_order_in_which_improve_adds_them() -> None:
    rows = [{**FATIGUE, "effect": name, "name": name.title()} for name in ("tremor", "fatigue", "potentiation")]
    diagnosis = {"verdict": "effect_missing", "missing": rows, "noise_sd_nm": 0.04, "add": ["fatigue", "tremor"]}
    view = explanation.view(diagnosis, None)
    assert [entry["id"] for entry in view["missing"]] == ["fatigue", "tremor", "potentiation"]
    assert view["advice"] == "Add “Fatigue”, then “Tremor” to the model."
    nothing = diagnosis | {"add": [], "missing": [{**FATIGUE, "next_experiment": "The ramp again."}]}
    said = explanation.view(nothing, None)["advice"]
    assert said.startswith("Add nothing yet") and said.endswith("The ramp again.")
    assert why_ended(nothing).startswith("Nothing more can be learnt"), "there is nothing to be done with this record"


def test_an_effect_that_explains_a_part_is_advised_and_not_denied() -> None:
    """The title told that no effect explains the error, beside one that lowered it by 78 % and was to be added."""
    part = {"verdict": "unexplained_structure", "missing": [{**FATIGUE, "probability": 0.45}], "noise_sd_nm": 0.04}
    said = conclude(part | {"add": ["fatigue"]})
    assert said.title == "Effects of the library explain a part of the error only"
    assert said.advice == "Add “Fatigue”: it explains a part."
    assert why_ended(part | {"add": ["fatigue"]}).startswith("More can be learnt from this record.")
    free = {"effect": "free_level", "name": "Free level"}
    both = conclude(part | {"add": ["fatigue", "free_level"], "free": [free], "deciding_experiment": {"text": "x"}})
    assert both.advice.startswith("Add “Fatigue”: it explains a part. Add “Free level”: it describes what is left")
    assert both.advice.endswith("The next experiment teaches most about it.")
    planned = conclude(part | {"add": ["fatigue"], "deciding_experiment": {"text": "x"}})
    assert planned.advice.endswith("it explains a part. Play the next experiment: it teaches most about what is left.")
    refused = part | {"add": []}
    assert conclude(refused).title == "The error has structure that no effect of the library explains"
    assert conclude(refused).advice.startswith("Look at the worst places")
    assert why_ended(refused).startswith("Nothing more can be learnt from this record alone.")


def test_what_is_left_to_add_is_said_by_the_diagnosis_that_named_it(
    client: httpx.Client, service: Service, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once one of two missing effects was added, a second search told that no effect explains the error."""
    rows = [{**FATIGUE, "effect": name, "name": name} for name in ("tremor", "fatigue")]
    found = {"verdict": "effect_missing", "missing": rows, "noise_sd_nm": 0.04, "add": ["fatigue", "tremor"],
             "base": {"held_out_rms_nm": 0.2, "rms_nm": 0.3}, "plain": ["as it was"]}  # fmt: skip
    left = explanation.remaining(found, ["fatigue"], {"held_out_rms_nm": 0.08, "rms_nm": 0.1, "figures": {}})
    assert [row["effect"] for row in left["missing"]] == left["add"] == ["tremor"]
    assert left["base"] == {"held_out_rms_nm": 0.08, "rms_nm": 0.1} and "2.0 times" in left["conclusion"]["words"]
    assert explanation.remaining(found, ["fatigue_of_mine"], {}) is found

    soon(lambda: service.context.analyses.known(model, "diagnosis"))
    service.context.analyses._keep(model, "diagnosis", found)
    searched: list[Any] = []
    submit = service.context.pool.submit

    def submitted(verb: str, **given: Any) -> Any:
        searched.extend([given] if verb == "diagnosis" and "model_json" in given else [])
        return submit(verb, **given)

    monkeypatch.setattr(service.context.pool, "submit", submitted)
    child = client.post(f"/v1/models/{model}/effects", json={"effects": ["fatigue"]}).json()["id"]
    told = service.context.analyses.known_diagnosis(service.context.versions.get(child))
    assert told and told["add"] == ["tremor"] and told["structure"] == ["fatigue"]
    assert told["conclusion"]["kind"] == "missing" and not searched


def test_a_free_effect_that_is_forced_and_asked_for_has_the_form_that_was_found(
    client: httpx.Client, service: Service, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = soon(lambda: service.context.analyses.known(model, "diagnosis"))
    free = {"effect": "fatigue", "form": "fitness", "name": "Fatigue", "words": "", "parameters": {}}
    service.context.analyses._keep(model, "diagnosis", {**found, "missing": [], "free": [free], "add": ["fatigue"]})
    submit, asked = service.context.pool.submit, []
    monkeypatch.setattr(
        service.context.pool,
        "submit",
        lambda verb, **given: (asked.append(given.get("effects")), submit(verb, **given))[1],
    )
    body = {"effects": ["fatigue"], "force": True, "reason": "seen with the eye"}
    assert client.post(f"/v1/models/{model}/effects", json=body).json()["without_evidence"] == []
    assert ["fatigue:fitness"] in asked


def test_a_free_effect_that_is_left_to_add_is_no_nothing() -> None:
    """Once the named effect was added the same document said "nothing to add" and asked for the free one."""
    free = {"effect": "free_level", "name": "Free level", "words": "", "parameters": {}}
    found = {"verdict": "effect_missing", "missing": [FATIGUE], "free": [free], "add": ["fatigue", "free_level"],
             "noise_sd_nm": 0.04, "base": {"held_out_rms_nm": 0.2}}  # fmt: skip
    left = explanation.remaining(found, ["fatigue"], {"held_out_rms_nm": 0.08})
    assert left["conclusion"]["kind"] == "unexplained" and "Free level" in left["conclusion"]["advice"]


def test_where_something_is_left_its_places_are_shown() -> None:
    """The verdict sent the reader to where the error sits, and there no place stood out."""
    found = {"verdict": "nothing_missing", "missing": [], "noise_sd_nm": 0.04, "where": [PLACE]}
    rows = [{"label": "ramp", "share_of_excess": 1.0}]
    comparison = {"noise_sd_nm": 0.04, "rms_nm": 0.04, "where": [PLACE], "by": {"segment": rows}}
    for check, count in ((True, 0), (False, 1)):
        view = explanation.view({**found, "residual_check": check}, comparison)
        shown = missing_parts(view, comparison)
        assert len(shown["places"]) == len(shown["splits"]) == count
    for passed, count in ((True, 0), (False, 1)):  # before a diagnosis is there
        tests = {"tests": [{"passed": passed}]}
        assert len(missing_parts(None, {**comparison, "tests": tests})["places"]) == count


def test_a_further_test_is_told_what_it_decided() -> None:
    missing = {"effect": "fatigue", "confused_with": []}
    experiment = {"rivals": ["fatigue", "potentiation"]}

    def said(*rows: dict[str, Any], held: tuple[str, ...] = (), asked: dict[str, Any] | None = experiment) -> str:
        return explanation.decided(asked, {"missing": list(rows)}, held).partition(": ")[2]

    assert said(missing) == "it is fatigue."
    assert said({**missing, "confused_with": ["potentiation"]}) == "it has not told them apart."
    assert said(missing, {**missing, "effect": "potentiation"}) == "it asks for more than one of them."
    assert said({**missing, "effect": "tremor"}) == "with it, none of them is asked for."
    assert (
        said(missing, held=("potentiation",)) == said(missing, asked=None) == said(missing, asked={"rivals": []}) == ""
    )


def test_what_left_out_or_held_out_rows_say_is_the_reason_at_every_door() -> None:
    """The page added what rows of `validate` objected to."""
    objected = {**FATIGUE, "objection": "On held-out pulses the error would rise."}
    with pytest.raises(ApiError) as refused:
        explanation.require_evidence({"missing": [objected]}, ["fatigue"])
    assert refused.value.detail.startswith("fatigue: On held-out pulses the error would rise.")
    assert explanation.refusals({"missing": [FATIGUE]}, ["fatigue"]) == {}


def test_an_error_that_is_shown_of_a_model_is_its_own() -> None:
    """Of a model with 0.056 N·m a second effect was shown to take it from 0.102 to 0.057, 44 % less: it was more."""
    first = {**FATIGUE, "held_out_rms_before_nm": 0.056, "held_out_rms_after_nm": 0.05}
    second = {**FATIGUE, "effect": "tremor", "held_out_rms_before_nm": 0.102, "held_out_rms_after_nm": 0.057}
    base = {"held_out_rms_nm": 0.0555, "rms_nm": 0.2}
    diagnosis = {"verdict": "effect_missing", "missing": [first, second], "noise_sd_nm": 0.04, "base": base, "add": []}
    view = explanation.view(diagnosis, None)
    assert [error[1] for error in view["missing"][0]["errors"]] == [0.2, 0.056]
    assert [error[1] for error in view["missing"][1]["errors"]] == [0.2] and view["to_add"] == []


def test_only_what_is_likely_missing_is_advised() -> None:
    """A person who adds whatever is possible ends with a model that is no better on new pulses."""
    sure, perhaps = FATIGUE, {**FATIGUE, "effect": "tremor", "name": "Tremor", "probability": 0.45}
    both = shown("effect_missing", [sure, perhaps], 6)
    assert both["likely"] == ["Fatigue"] and both["title"] == "An effect is missing in this model"
    found = shown("effect_missing", [perhaps], 6)
    assert found["likely"] == [] and "possibly missing" in found["title"] and len(found["missing"]) == 1


def test_a_job_that_fails_has_a_page_that_says_why(client: httpx.Client, pages: httpx.Client, model: str) -> None:
    job = client.post(f"/v1/models/{model}/effects?wait=false", json={"effects": ["tremor"]}).json()["id"]
    page = soon(lambda: (found := pages.get(f"/jobs/{job}")).status_code != 200 and found)
    assert page.status_code == 409
    assert "gives no evidence for this effect" in page.text and "Back to the model" in page.text


def test_cancelled_diagnosis_offers_to_begin_anew(client: httpx.Client, service: Service, participant: str) -> None:
    make_slow(service)
    model = run_test(client, participant)["model_id"]
    with signed_in(service) as browser:
        job = re.findall(r'data-call="DELETE (/v1/jobs/\w+)"', browser.get(f"/models/{model}").text)[0]
        assert client.delete(job).json()["state"] == "cancelled"
        page = browser.get(f"/models/{model}").text
        assert "Diagnose now" in page and "data-job" not in page


def test_a_model_on_another_recording(client: httpx.Client, pages: httpx.Client, model: str, participant: str) -> None:
    other = run_test(client, participant)["model_id"]
    assert "On the other recording" in pages.get("/compare", params={"model": [model, other]}).text
    recording = client.get(f"/v1/models/{other}").json()["recording_id"]
    for name, status in ((recording, 200), ("none", 404)):
        assert client.get(f"/v1/models/{model}/comparison", params={"recording": name}).status_code == status


def test_real_worker_finds_what_is_missing_and_the_page_shows_it(tmp_path: Path) -> None:
    """identify's own answers carry what page and routes build on."""
    from stimrig.api.jobs import verbs
    from stimrig.api.jobs.curves import comparison
    from stimrig.api.jobs.verbs import fit
    from stimrig.api.web.responses.models import ComparisonOut, DiagnosisOut

    path = str(tmp_path / "record.csv")
    hidden_records.write_csv(hidden_records.generate("asymmetric_relaxation", "middle", 8, rate_hz=100), path)
    told: list[float] = []
    with few_effects.only("asymmetric_relaxation", "fatigue", "recruitment_hysteresis", "potentiation"):
        found = verbs.diagnosis(path, lambda share, _text="": told.append(share))
    DiagnosisOut.model_validate(found)
    assert told == sorted(told) and told[-1] <= 1 and len(told) >= 4
    assert (found["structure"], found["verdict"]) == ([], "effect_missing")
    assert [entry["effect"] for entry in found["missing"]] == ["asymmetric_relaxation"]
    model = fit(path, lambda *_: None)
    compared = comparison(path, lambda *_: None, model["json"])
    ComparisonOut.model_validate(compared)
    assert 1000 < len(compared["series"]["time_s"]) <= 2400
    view = explanation.view(found, compared)
    assert [entry["effect"] for entry in view["missing"]] == ["asymmetric_relaxation"]
    assert {split["title"] for split in explanation.splits(compared)} == {
        str(title) for title in explanation.SPLITS.values()
    }
