"""The trend over sessions: one point each, its figures with uncertainty, what changed, as JSON, CSV and page."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig import identify
from stimrig.api.models import changes, stored_model
from stimrig.api.models.changes import State
from stimrig.api.store.tables import Analysis, Model
from stimrig.api.workers.pool import WORKER
from tests.api.conftest import Service, run_service
from tests.harness import sessions
from tests.harness.muscle import Patient
from tests.harness.sessions import Planned


def made(service: Service, code: str, planned: list[Planned]) -> list[str]:
    context = service.app.state.context
    return sessions.make(context.store, context.settings.recordings_dir, code, planned)


def trend(client: httpx.Client, code: str) -> dict[str, Any]:
    answer = client.get(f"/v1/participants/{code}/trend")
    assert answer.status_code == 200, answer.text
    return answer.json()


def three(**last: Any) -> list[Planned]:
    """Two equal sessions with another muscle in between that nobody approved, then one as told."""
    muscle = Patient()
    weaker = replace(muscle, gain=0.5 * muscle.gain)
    end = Planned(muscle, 14.0, approved=False)
    return [Planned(muscle, 0.0), Planned(weaker, 7.0, approved=False), replace(end, **last)]


def test_figures_carry_deviations_that_agree_with_what_pages_show() -> None:
    document = identify.fit(sessions.record(Planned(Patient(), 0.0), 3)).to_dict()
    figures = document["uncertainty"]["figures"]
    read_off = {**stored_model.recruitment(document), **stored_model.dynamics(document)}
    for name, figure in figures.items():
        assert figure["value"] == pytest.approx(read_off[name], rel=1e-9), name
        assert 0 < figure["sd"] < 0.1 * max(abs(figure["value"]), 0.05), name


def test_deviations_are_those_of_repeated_records() -> None:
    """Of twelve records of one muscle the figures scatter as the models say, within what twelve can tell."""
    found = [identify.fit(sessions.record(Planned(Patient(), 0.0), seed)).figures() for seed in range(12)]
    for name in ("plateau_nm", "time_constant_s", "damping", "threshold_us"):
        values = [figures[name]["value"] for figures in found]
        middle = sum(values) / len(values)
        scatter = (sum((value - middle) ** 2 for value in values) / (len(values) - 1)) ** 0.5
        said = sum(figures[name]["sd"] for figures in found) / len(found)
        assert 0.4 < scatter / said < 2.2, (name, scatter, said)


def test_one_point_a_session_approved_first_and_the_newest_version_else(service: Service, client: httpx.Client) -> None:
    ids = made(service, "P017", three())
    context = service.app.state.context
    row = context.versions.get(ids[2])
    later = {**json.loads(row.document), "model_id": "a-second-version"}
    context.versions.add(json.dumps(later), "P017", row.recording_id, "Ada", parent_id=row.id)
    found = trend(client, "P017")["sessions"]
    assert [one["model_id"] for one in found] == [ids[0], ids[1], "a-second-version"]
    assert [one["approved"] for one in found] == [True, False, False]
    assert [one["versions"] for one in found] == [1, 1, 2]
    context.versions.decide(ids[2], True, "Ada", "the first one")
    last = trend(client, "P017")["sessions"][2]
    assert (last["model_id"], last["approved_by"]) == (ids[2], "Ada")
    context.versions.decide(ids[2], False, "Ada", "no, it is not")
    assert trend(client, "P017")["sessions"][2]["model_id"] == "a-second-version"


def test_what_changed_is_told_against_the_last_approved_session(service: Service, client: httpx.Client) -> None:
    made(service, "P017", three())
    same = trend(client, "P017")["changes"]
    assert same["differences"] == [] and same["doubts"] == []
    assert same["sentences"] == ["Nothing changed beyond its uncertainty since 03 Aug 2026."]
    weaker = replace(Patient(), gain=0.82 * Patient().gain)
    made(service, "P018", three(patient=weaker))
    found = trend(client, "P018")["changes"]
    assert [one["figure"] for one in found["differences"]] == ["plateau_nm"]
    assert found["sentences"] == ["Plateau 18\u00a0% lower than on 03 Aug 2026, more than twice its uncertainty."]


def test_a_plateau_at_another_current_is_no_comparison(service: Service, client: httpx.Client) -> None:
    stronger = replace(Patient(), gain=1.4 * Patient().gain, time_constant_s=0.7)
    made(service, "P017", three(patient=stronger, current_ma=25.0, notes={"electrodes": "moved"}))
    found = trend(client, "P017")["changes"]
    assert [one["figure"] for one in found["differences"]] == ["time_constant_s"]
    assert found["doubts"] == [
        "The current was 20.0\u00a0mA, now it is 25.0\u00a0mA: threshold and plateau are not compared.",
        "The notes on electrodes differ: “–”, then “moved”.",
    ]


def test_other_effects_are_said_and_only_large_differences_told() -> None:
    plateau = {"plateau_nm": {"value": 5.0, "sd": 0.01, "unit": "N·m"}}
    more = {"plateau_nm": {"value": 5.9, "sd": 0.01, "unit": "N·m"}}
    before = State(plateau, "maximum-likelihood", (), 20.0)
    assert [one["figure"] for one in changes.changed(before, replace(before, figures=more))] == ["plateau_nm"]
    other = replace(before, figures=more, structure=("fatigue:fitness",))
    assert changes.changed(before, other) == []
    assert [one["kind"] for one in changes.doubts(before, other)] == ["effects"]


def test_models_from_before_the_figures_are_read_once(tmp_path: Path, short_dir: Path) -> None:
    for service in run_service(tmp_path, short_dir, WORKER):
        with service.client() as client:
            _read_once(service, client)


def _read_once(service: Service, client: httpx.Client) -> None:
    ids = made(service, "P017", three())
    stored = trend(client, "P017")["sessions"]
    store = service.app.state.context.store
    with store.write() as session:
        for identity in ids:
            row = session.get(Model, identity)
            document = json.loads(row.document)
            del document["uncertainty"]["figures"]
            row.document, row.fit = json.dumps(document).encode(), {k: v for k, v in row.fit.items() if k != "figures"}
            row.etag = hashlib.sha256(row.document).hexdigest()
    assert trend(client, "P017")["sessions"] == stored
    assert len(store.all(Analysis, Analysis.kind == "headline")) == 3
    with store.write() as session:  # what is kept is what is shown
        kept = session.get(Analysis, (ids[0], "headline"))
        kept.document = {**kept.document, "plateau_nm": {"value": 99.0, "sd": None, "unit": "N·m"}}
    again = trend(client, "P017")["sessions"][0]["figures"]["plateau_nm"]
    assert (again["value"], again["uncertainty"]) == (99.0, None)


def test_the_table_has_units_times_and_no_formulas(service: Service, client: httpx.Client) -> None:
    made(service, "P017", three(notes={"electrodes": "=1+1"}, current_ma=21.5))
    answer = client.get("/v1/participants/P017/trend.csv")
    assert answer.headers["content-type"].startswith("text/csv")
    head, *rows = csv.reader(io.StringIO(answer.text))
    assert {"threshold_us (µs)", "threshold_us sd (µs)", "current_ma (mA)", "session_utc"} <= set(head)
    last = dict(zip(head, rows[-1], strict=True))
    assert last["current_ma (mA)"] == "21.5" and last["session_utc"].endswith("Z")
    assert last["notes"].endswith("electrodes: =1+1") and not last["notes"].startswith("=")
    assert all(not cell.startswith(("=", "@", "+")) for row in rows for cell in row)


def test_nobody_and_no_session(service: Service, client: httpx.Client, participant: str) -> None:
    assert client.get("/v1/participants/P999/trend").status_code == 404
    assert trend(client, participant) == {"participant": participant, "sessions": [], "changes": None}
    page = client.get(f"/participants/{participant}/trend")
    assert "No session with a model yet." in page.text and '<svg class="trend"' not in page.text
    made(service, "P018", three()[:1])
    first = client.get("/participants/P018/trend").text
    assert "The trend begins with the second one." in first and first.count('<svg class="trend"') == 9


@pytest.mark.parametrize(
    ("value", "uncertainty", "words"),
    [
        (0.000735, 0.0063, "0.001 ± 0.013"),
        (-0.00001, 0.004, "0.0000 ± 0.0080"),
        (12.34, 1.6, "12.3 ± 3.2"),
        (0.4, None, "0.400"),
    ],
)
def test_a_figure_shows_no_digits_that_nobody_knows(value: float, uncertainty: float | None, words: str) -> None:
    name = changes.name_of("fatigue.depth")
    assert changes.uncertain_words(value, uncertainty, name) == words
