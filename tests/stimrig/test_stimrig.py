"""`import stimrig`: quick to import, the names of the contract, results that show and draw themselves, progress."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

import stimrig
from stimrig import Client, errors
from stimrig.api.progress_bar import in_notebook
from stimrig.api.web.responses.models import JobOut
from stimrig.errors import BadRequest
from tests.api.conftest import PATIENCE_S, TOKEN, Service
from tests.api.test_jobs import made_up_csv
from tests.harness import few_effects

pytestmark = pytest.mark.slow

NAMES = {
    "read", "fit", "predict", "compare", "diagnose", "improve", "next_experiment", "effects", "plot", "Model", "Record",
    "Client", "emulate", "explain", "invert", "join", "save", "schema", "table1", "track",
}  # fmt: skip
HEAVY = {
    "numpy", "scipy", "numba", "h5py", "matplotlib", "httpx", "tqdm", "pydantic", "fastapi", "sqlalchemy",
}  # fmt: skip


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> stimrig.Record:
    return stimrig.read(made_up_csv(tmp_path_factory.mktemp("stimrig") / "record.csv"))


@pytest.fixture(scope="module")
def model(record: stimrig.Record) -> stimrig.Model:
    return stimrig.fit(record)


def test_importing_it_loads_no_library() -> None:
    code = "import sys, stimrig; print(*{name.removeprefix('stimrig.').partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "identify" in loaded
    assert not HEAVY & set(loaded)


def test_it_works_in_a_folder_with_packages_of_our_folders_names(tmp_path: Path) -> None:
    """Whatever a project of one's own calls its packages: all of ours are parts of `stimrig`."""
    for name in ("api", "rig", "identify", "hardware_sim", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('this is not stimrig')\n")
    code = "import stimrig; print(stimrig.fit, stimrig.Client, stimrig.effects()[0])"
    for command in (["-c", code], ["-m", "stimrig.rig", "--help"]):
        subprocess.run([sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, check=True)


def test_names_are_those_of_the_contract() -> None:
    assert set(stimrig.__all__) == NAMES | {"carry", "cohort", "errors"}
    assert all(callable(getattr(stimrig, name)) for name in NAMES)
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        stimrig.fitt  # noqa: B018


def test_a_model_draws_itself_beside_its_record(model: stimrig.Model, record: stimrig.Record) -> None:
    figure = model.plot(record)
    lines = figure.lines()
    assert [*lines] == ["measured", "model, free run", "measured − model", "pulse width"]
    measured = lines["measured"]
    assert measured.x[0] == record.time_s[0] and max(measured.y) == pytest.approx(record.torque_nm.max(), abs=1e-4)
    assert list(model.plot().lines()["model"].y) == pytest.approx(list(model.recruitment.table()[1]))


def test_what_cannot_be_drawn_says_what_can() -> None:
    with pytest.raises(BadRequest, match=r"plot\(model, record\)"):
        stimrig.plot({})


def test_next_experiment_of_a_diagnosis_is_its_first_undecided_effect(record: stimrig.Record) -> None:
    with few_effects.only("threshold_drift"):
        diagnosis = stimrig.diagnose(record, progress=False)
    planned = stimrig.next_experiment(record, ["threshold_drift", "recruitment_hysteresis"])
    assert planned is not None and planned.rivals == ("threshold_drift", "recruitment_hysteresis")
    assert str(planned).startswith("Next experiment: threshold_drift or recruitment_hysteresis")
    plan = {name: value for name, value in planned.to_dict().items() if name != "rivals"}
    rows = [
        {"effect": effect, "confused_with": confused, "next_experiment_plan": plan_of_it}
        for effect, confused, plan_of_it in (
            ("tremor", [], plan), ("mains_hum", ["tremor"], None), ("threshold_drift", ["fatigue", "tremor"], plan),
            ("fatigue", ["tremor"], {**plan, "text": "of another"}),
        )
    ]  # fmt: skip
    found = stimrig.next_experiment(replace(diagnosis, missing=rows))
    assert found is not None and found.rivals == ("threshold_drift", "fatigue") and found.text == planned.text
    assert stimrig.next_experiment(replace(diagnosis, missing=rows[:2])) is None


def test_progress_may_be_a_function_of_ones_own(record: stimrig.Record) -> None:
    shares: list[float] = []
    stimrig.fit(record, effects=["fatigue"], progress=lambda share, _: shares.append(share))
    assert shares == sorted(shares) and shares[-1] == 1.0


@pytest.mark.parametrize(("config", "notebook"), [({"IPKernelApp": {}}, True), ({}, False)])
def test_a_notebook_is_known_by_its_kernel(monkeypatch: pytest.MonkeyPatch, config: dict[str, object], notebook: bool):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(config=config)))
    assert in_notebook() == notebook


# ---- `stimrig.Client` against a served app: the whole path of a session, live signals, jobs, and its errors


@pytest.fixture
def client(service: Service) -> Any:
    with Client(service.url, TOKEN, PATIENCE_S) as client:
        client.make_participant("P017")
        yield client


def test_a_session_from_participant_to_controller(client: Client, service: Service) -> None:
    seen: list[float] = []
    test = client.run_test("P017", lambda now: seen.append(now["progress"]))
    assert test["state"] == "completed" and seen == sorted(seen)
    with pytest.raises(errors.NotFound, match="No approved model") as caught:
        client.approved_model("P017")
    assert caught.value.status == 404 and caught.value.code == "no-approved-model"
    assert client.approve(test["model_id"], "good fit")["served"]
    with Client(service.url, client.issue_token("controller", ["read-model"])) as controller:
        first = controller.approved_model("P017")
        again = controller.approved_model("P017", first)
        assert first.changed and first.document["model_id"] == test["model_id"]
        assert not again.changed and again.document == first.document
        with pytest.raises(errors.Forbidden):
            controller.start_test("P017")
    assert client.recording(test["recording_id"]).startswith(b"\x89HDF")
    assert client.reject(test["model_id"])["decision"] == "rejected"
    assert [row["id"] for row in client.versions("P017")] == [client.version(test["model_id"])["id"]]


def test_long_work_is_a_job_that_is_followed_and_cancelled_by_what_progress_raises(client: Client) -> None:
    """Each asks for a job and follows it: an answer that waits for the work would come after `timeout_s`."""
    model_id, asked, told = client.run_test("P017")["model_id"], list[str](), list[tuple[float, str]]()
    client.http.event_hooks = {"request": [lambda request: asked.append(str(request.url))]}
    with pytest.raises(KeyboardInterrupt):
        client.improve(model_id, Mock(side_effect=KeyboardInterrupt))
    assert client.get(asked[-1])["done"], "nothing goes on behind the person's back"
    child = client.add_effects(model_id, ["fatigue"], progress=lambda *now: told.append(now))
    assert child["parent_id"] == model_id and child["effects"] == ["fatigue"] and told[-1] == (1.0, "done")
    with pytest.raises(errors.Conflict, match=r"in the model"):
        client.add_effects(child["id"], ["fatigue"])
    assert client.improve(model_id)["parent_id"] and client.diagnosis(model_id)["verdict"]
    for name in ("improve", "diagnosis", "effects"):
        assert any(url.endswith(f"/{name}?wait=false") for url in asked), asked
    assert any("/jobs/J" in url for url in asked), "and the job is asked after"


def test_stop_is_confirmed_and_the_test_says_so(client: Client, service: Service) -> None:
    service.rig.speed = 1.0
    test_id = client.start_test("P017")["id"]
    assert client.stop("enough")["stopped"]
    *_, last = client.follow(test_id)
    assert last["state"] == "stopped"


def test_errors_carry_the_problem(client: Client) -> None:
    asked: list[tuple[Any, type[errors.Refused], int]] = [
        (lambda: client.version("M0"), errors.NotFound, 404),
        (lambda: client.make_participant("P017"), errors.Conflict, 409),
        (lambda: client.preview("P017", segments=[{"name": "x", "sequence": "polka"}]), errors.Invalid, 422),
        (lambda: client.post("/v1/participants/P017/recordings", content=b""), errors.Invalid, 422),
    ]
    for ask, error, status in asked:
        with pytest.raises(error) as caught:
            ask()
        found = caught.value
        assert found.status == status and found.title and found.detail
        assert str(found) == f"{found.request}: {found.title}: {found.detail}"
        assert isinstance(found, errors.ServiceError) and found.document["status"] == status
    with Client(str(client.http.base_url), "guessed") as stranger, pytest.raises(errors.Unauthorized):
        stranger.get("/v1/participants")


@pytest.mark.parametrize("address", ["http://127.0.0.1:{port}", "no address", "http://[::1"])
def test_without_an_answer_the_error_names_the_address(address: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, and never listening
        url = address.format(port=taken.getsockname()[1])
        with pytest.raises(errors.Unreachable) as caught, Client(url) as client:
            client.health()
    assert url in str(caught.value) and caught.value.status is None


def test_an_answer_is_read_by_name_or_by_key_and_one_of_a_newer_service_is_kept() -> None:
    sent = {"id": "J1", "state": "waiting", "later": {"a": 1}}
    job = JobOut.read(sent)
    assert job.state == job["state"] == job.get("state") == "waiting" and job.get("none") is None
    assert "later" in job and job["later"] == {"a": 1} and job.to_dict() == sent == {**job}


TEXT = (Path(__file__).parents[2] / "docs" / "python.md").read_text("utf-8")


def test_the_page_names_everything() -> None:
    for name in stimrig.__all__:
        assert re.search(rf"`(stimrig\.)?{name}\b", TEXT), name
