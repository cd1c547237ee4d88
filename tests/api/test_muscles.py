"""A model of both muscles: from a test or an upload to a version, its page, its approval, and what it lacks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.models import stored_model
from stimrig.api.models.family import SEVERAL_MUSCLES
from stimrig.api.workers import verbs
from stimrig.identify import muscles
from stimrig.identify.muscles.verbs import parted
from tests.api.conftest import Service, csrf, own_service, signed_in, wait_done
from tests.api.made_up_muscles import HEADER, write_csv
from tests.api.stub_worker import CROSS_TALK, joint_model
from tests.api.test_channels import OWN, PERSON, TRICEPS, TWO, seen_of, two

__all__ = ["two"]
service = own_service()


@pytest.fixture
def model(two: httpx.Client) -> Iterator[str]:
    """The model of a test of both muscles."""
    assert two.put(f"{TRICEPS}/profile", json=OWN).status_code == 200
    test = two.post("/v1/tests", json={"participant": "P017", "kind": "muscles"}).json()
    done = wait_done(two, test["id"])
    assert done["state"] == "completed" and done["model_id"], done
    yield done["model_id"]


# ---- the document -------------------------------------------------------------------------------------------------


def test_a_document_says_what_it_holds_of_each_muscle() -> None:
    document = joint_model(["biceps.fatigue", CROSS_TALK, "co_contraction"])
    assert list(stored_model.muscles_of(document)) == TWO and stored_model.muscles_of({"recruitment": {}}) == {}
    assert list(stored_model.structure(document)) == ["biceps.fatigue", CROSS_TALK, "co_contraction"]
    assert stored_model.structure(document)[CROSS_TALK] == f"{CROSS_TALK}:made-up"
    assert not stored_model.is_plain(document) and stored_model.is_plain(joint_model([]))
    figures = stored_model.muscle_figures(document)
    assert figures["biceps.plateau_nm"]["value"] == 6.0 and figures["triceps.plateau_nm"]["value"] == pytest.approx(
        -3.6
    )


def test_effects_are_parted_by_their_channels() -> None:
    asked = ["fatigue", "biceps.fatigue:fitness", "triceps.tremor", CROSS_TALK, "co_contraction:stiffness"]
    own, between, neither = parted(asked, TWO)
    assert own == {"biceps": ["fatigue:fitness"], "triceps": ["tremor"]}
    assert between == [CROSS_TALK, "co_contraction:stiffness"]
    assert neither == ["fatigue"], "what names no channel is of one muscle's structure"


# ---- versions -----------------------------------------------------------------------------------------------------


def test_a_test_of_both_gives_a_version_that_is_served(two: httpx.Client, model: str) -> None:
    version = two.get(f"/v1/models/{model}").json()
    assert (version["method"], version["effects"], version["model"]["kind"]) == ("joint", [], "joint")
    assert version["figures"]["triceps.threshold_us"]["unit"] == "µs"
    approved = two.post(f"/v1/models/{model}/approve", json={"tracking": {"gain_percent": 20.0}}).json()
    assert approved["served"] and approved["tracking"] is None, "it is not tracked, whatever is asked"
    served = two.get(f"{PERSON}/model")
    assert [one["name"] for one in served.json()["channels"]] == TWO and served.headers["etag"]
    assert two.get(f"{PERSON}/model", params={"tracked": True}).json()["model_id"] == model
    moved = {"side": "left", "muscle": "triceps brachii", "placement": "elsewhere"}
    assert two.put(f"{TRICEPS}/muscle", json=moved).status_code == 200
    assert two.get(f"{PERSON}/model").status_code == 404, "the second muscle's electrodes are elsewhere now"
    refused = two.post(f"/v1/models/{model}/approve")
    assert refused.status_code == 409 and refused.json()["type"].endswith("other-site")


def test_what_nobody_saw_is_not_approved(two: httpx.Client, model: str, service: Service) -> None:
    """A page from before another decision approves nothing."""
    with signed_in(service) as tab:
        old = seen_of(tab.get(f"/models/{model}").text)
        assert two.post(f"/v1/models/{model}/reject", json={"reason": "no"}).status_code == 200
        answer = tab.post(f"/models/{model}/approve", data={"csrf": csrf(tab), "seen": old})
        assert answer.status_code == 409 and not two.get(f"/v1/models/{model}").json()["model"].get("approved")
        assert two.get(f"{PERSON}/model").status_code == 404


def test_interplay_and_a_muscles_effects_are_added_and_undone(two: httpx.Client, model: str) -> None:
    found = two.get(f"/v1/models/{model}/diagnosis").json()
    assert [row["effect"] for row in found["missing"]] == [CROSS_TALK, "co_contraction"]
    new = two.post(f"/v1/models/{model}/effects", json={"effects": [CROSS_TALK]})
    assert new.status_code == 201, new.text
    child = new.json()
    assert (child["effects"], child["parent_id"], child["added_effect"]) == ([CROSS_TALK], model, CROSS_TALK)
    refused = two.post(f"/v1/models/{model}/effects", json={"effects": ["biceps.fatigue"]})
    assert refused.status_code == 409 and "speaks against it" in refused.json()["detail"]
    forced = {"effects": ["biceps.fatigue"], "force": True, "reason": "it is known of this person"}
    tired = two.post(f"/v1/models/{child['id']}/effects", json=forced).json()
    assert tired["effects"] == ["biceps.fatigue", CROSS_TALK] and tired["without_evidence"] == ["biceps.fatigue"]
    for wrong in ("fatigue", "soleus.fatigue", "biceps.nothing", "cross_talk:biceps>soleus"):
        refused = two.post(f"/v1/models/{model}/effects", json={"effects": [wrong]})
        assert refused.status_code == 422 and "cross_talk:triceps>biceps" in refused.json()["detail"], wrong
    back = two.post(f"/v1/models/{child['id']}/undo").json()
    assert back["id"] == model


def test_it_is_improved_step_by_step(two: httpx.Client, model: str) -> None:
    found = two.post(f"/v1/models/{model}/improve").json()
    assert [row["effects"] for row in found["versions"]] == [[], [CROSS_TALK], [CROSS_TALK, "co_contraction"]]


def lacking(two: httpx.Client, model: str) -> dict[str, httpx.Response]:
    """Everything that is asked of one muscle's model alone."""
    assert two.post(f"/v1/models/{model}/approve").status_code == 200
    return {
        "tracking": two.get(f"{PERSON}/tracking"),
        "prediction": two.post(f"/v1/models/{model}/prediction", json={"pulse_width_us": [100.0]}),
        "widths": two.post(f"/v1/models/{model}/widths", json={"reference_torque_nm": [1.0, 2.0]}),
        "joined": two.post("/v1/tests", json={"participant": "P017", "joins": model}),
        "compared": two.get("/compare", params={"model": [model, other(two, model)]}),
        "story": two.get(f"/models/{model}/story.html"),
    }


def other(two: httpx.Client, model: str) -> str:
    return str(two.post(f"/v1/models/{model}/effects", json={"effects": [CROSS_TALK]}).json()["id"])


def test_what_it_lacks_is_said_in_one_line(two: httpx.Client, model: str) -> None:
    answers = lacking(two, model)
    for what, answer in answers.items():
        assert answer.status_code == 409, (what, answer.status_code, answer.text)
        assert SEVERAL_MUSCLES.lacks[what] in answer.text.replace("&#39;", "'"), what
    trend = two.get(f"{PERSON}/trend").json()
    assert trend["sessions"] == [] and trend["left_out"] == SEVERAL_MUSCLES.lacks["trend"]
    assert set(SEVERAL_MUSCLES.lacks) - set(answers) == {"trend", "carried"}


def test_a_plain_test_after_it_begins_plainly(two: httpx.Client, model: str) -> None:
    """Its structure is not carried over, and its curves do not foretell another test's torque."""
    assert two.post(f"/v1/models/{model}/approve").status_code == 200
    preview = two.post("/v1/preview", json={"participant": "P017"}).json()
    assert preview["torque_time_nms"] is None
    test = two.post("/v1/tests", json={"participant": "P017"}).json()
    done = wait_done(two, test["id"])
    assert done["state"] == "completed" and done["fit"]["carried"] is None and done["fit"]["method"] != "joint"


def test_a_table_with_two_columns_of_widths_is_taken_in(two: httpx.Client) -> None:
    text = f"{HEADER}\n0,0,0,0,rest\n0.0025,0,0,0,rest\n"
    made = two.post(f"{PERSON}/recordings", content=text.encode(), headers={"Content-Type": "text/csv"})
    assert made.status_code == 201 and made.json()["model"]["method"] == "joint", made.text


# ---- pages --------------------------------------------------------------------------------------------------------


def test_its_page_shows_each_muscle_in_its_colour(two: httpx.Client, model: str, service: Service) -> None:
    two.get(f"/v1/models/{model}/diagnosis")
    with signed_in(service) as tab:
        text = tab.get(f"/models/{model}").text
        for number, name in enumerate(TWO, start=1):
            assert f'<span class="muscle n{number}" translate="no">{name}</span>' in text
        assert "0.051" in text and "0.052" in text and "0.077" in text, "the errors alone and together"
        assert SEVERAL_MUSCLES.lacks["tracking"] in text and f"/models/{model}/widths" not in text
        assert "Cross-talk (biceps → triceps)" in text and "The electrode of one muscle also reaches the other" in text
        for name in ("recruitment", "step", "comparison", "overview"):
            still = tab.get(f"/models/{model}/figures/{name}.html")
            assert "var(--muscle-1)" in still.text and "var(--muscle-2)" in still.text, name
        report = tab.get(f"/models/{model}/report").text
        assert "#1c00a4" in report and "#bd21bd" in report and 'class="muscle n2"' in report
        listed = tab.get("/participants/P017").text
        assert f"/models/{model}" in listed
        wide = tab.get(f"/models/{model}/widths")
        assert wide.status_code == 409 and "with the model of one muscle" in wide.text
        trend = tab.get("/participants/P017/trend").text
        assert SEVERAL_MUSCLES.lacks["trend"] in trend
        told = tab.get(f"/models/{model}/story")
        assert told.status_code == 303 and told.headers["location"] == f"/models/{model}#versions"
        added = tab.post(f"/models/{model}/effects", data={"csrf": csrf(tab), "effect": CROSS_TALK})
        assert added.status_code == 303
        child = two.get(f"{PERSON}/models").json()[0]["id"]
        page = tab.get(f"/models/{child}").text
        assert "cross-talk (biceps → triceps)" in page


# ---- a worker that really fits ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_csv(tmp_path_factory.mktemp("two") / "two.csv", seed=3)


def asked(verb: str, **given: Any) -> dict[str, Any]:
    return verbs.VERBS[verb](progress=lambda *_: None, **given)


def test_the_workers_verbs_take_recordings_of_two(table: Path, tmp_path: Path) -> None:
    """One fit for all of them: it takes seconds."""
    found = asked("fit", data=str(table), effects=["fatigue"], method="maximum-likelihood")
    assert found["model"]["kind"] == "joint" and found["model"]["fit"]["held_out_fit_percent"] > 90
    assert stored_model.structure(found["model"]) == {}, "of one muscle's structure nothing is taken over"
    model_json = found["json"]
    compared = asked("comparison", data=str(table), model_json=model_json)
    assert set(compared["alone"]) == set(TWO) and compared["fit_percent"] > 90 and compared["series"]["residual_nm"]
    drawn = asked("curves", data=str(table), model_json=model_json)
    parts = [drawn["muscles"][name]["torque_nm"] for name in TWO]
    assert max(parts[0]) > 1.0 and min(parts[1]) < -1.0, "they pull against each other"
    whole = [a + b for a, b in zip(*parts, strict=True)]
    rest_nm = drawn["predicted_torque_nm"][0]
    assert max(abs(w + rest_nm - p) for w, p in zip(whole, drawn["predicted_torque_nm"], strict=True)) < 0.02
    out = tmp_path / "out.csv"
    asked("export_csv", data=str(table), out=str(out))
    assert out.read_text().splitlines()[0] == HEADER
    kept, again = (muscles.read(path) for path in (table, out))
    for one, other_one in zip(kept.records, again.records, strict=True):
        assert (one.pulse_width_us == other_one.pulse_width_us).all()


# ---- a controller's trials ----------------------------------------------------------------------------------------

TRIAL: dict[str, Any] = {
    "participant": "P017",
    "kind": "sequence",
    "segments": [
        {
            "name": "trial",
            "sequence": "widths",
            "settings": {"pulse_width_us": [0.0, 60.0, 80.0] * 20},
            "channels": {"triceps": {"sequence": "widths", "settings": {"pulse_width_us": [50.0, 0.0, 0.0] * 20}}},
        }
    ],
}


def key_with(two: httpx.Client, service: Service, current_ma: float) -> httpx.Client:
    """A client with a controller's key."""
    plan = {"name": "ilc", "current_ma": current_ma, "max_pulse_width_us": 200.0, "max_duration_s": 60.0, "trials": 3}
    made = two.post(f"{PERSON}/keys", json=plan)
    assert made.status_code == 201, made.text
    return httpx.Client(base_url=service.url, headers={"Authorization": f"Bearer {made.json()['key']}"}, timeout=20.0)


def test_a_trial_plays_on_both_muscles(two: httpx.Client, model: str, service: Service) -> None:
    assert two.post(f"/v1/models/{model}/approve", json={}).status_code == 200
    started = two.post("/v1/tests", json=TRIAL)
    assert started.status_code == 202, started.text
    done = wait_done(two, started.json()["id"])
    assert done["state"] == "completed", done
    played: Any = service.rig.last_plan
    assert [one.name for one in played.channels] == TWO
    assert [one.profile.current_ma for one in played.channels] == [20.0, OWN["current_ma"]]
    assert played.segments[0].channels["triceps"].sequence == "widths"


def test_a_key_plays_on_both_within_its_plan(two: httpx.Client, model: str, service: Service) -> None:
    assert two.post(f"/v1/models/{model}/approve", json={}).status_code == 200
    for current_ma, status, said in ((10.0, 403, "triceps has 12 mA"), (20.0, 202, "")):
        with key_with(two, service, current_ma) as controller:
            tag = controller.get(f"{PERSON}/model").headers["etag"]
            answer = controller.post("/v1/tests", json=TRIAL, headers={"If-Match": tag})
            assert answer.status_code == status and said in answer.text, answer.text


def test_a_key_of_one_muscles_model_plays_on_one(two: httpx.Client, service: Service) -> None:
    assert two.put(f"{TRICEPS}/profile", json=OWN).status_code == 200
    done = wait_done(two, two.post("/v1/tests", json={"participant": "P017"}).json()["id"])
    assert two.post(f"/v1/models/{done['model_id']}/approve", json={}).status_code == 200
    with key_with(two, service, 20.0) as controller:
        tag = controller.get(f"{PERSON}/model").headers["etag"]
        answer = controller.post("/v1/tests", json=TRIAL, headers={"If-Match": tag})
        assert answer.status_code == 403 and "of one muscle" in answer.text, answer.text
