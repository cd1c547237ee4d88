"""The trend over sessions: figures with uncertainty, what changed; JSON and pages."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import httpx
import pytest

from stimrig import identify
from stimrig.api.charts.figure import Axis, Line, Rule
from stimrig.api.charts.trend_charts import Point, history
from stimrig.api.models import changes, stored_model
from stimrig.api.models.changes import State
from tests.api.conftest import Service, shared_service
from tests.harness import sessions
from tests.harness.muscle import Patient
from tests.harness.sessions import Planned

service = shared_service()


def made(service: Service, code: str, planned: list[Planned]) -> list[str]:
    context = service.context
    return sessions.make(context.store, context.settings.recordings_dir, code, planned)


def trend(client: httpx.Client, code: str) -> dict[str, Any]:
    answer = client.get(f"/v1/participants/{code}/trend")
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_figures_carry_deviations_that_agree_with_what_pages_show() -> None:
    document = identify.fit(sessions.record(Planned(Patient(), 0.0), 3)).to_dict()
    figures = document["uncertainty"]["figures"]
    read_off = {**stored_model.recruitment(document), **stored_model.dynamics(document)}
    for name, figure in figures.items():
        assert figure["value"] == pytest.approx(read_off[name], rel=1e-9), name
        assert 0 < figure["sd"] < 0.1 * max(abs(figure["value"]), 0.05), name


def test_one_point_a_session_approved_first_and_the_newest_version_else(service: Service, client: httpx.Client) -> None:
    muscle = Patient()
    unlike = Planned(replace(muscle, gain=0.5 * muscle.gain), 7.0, approved=False)
    ids = made(service, "ONE", [Planned(muscle, 0.0), unlike, Planned(muscle, 14.0, approved=False)])
    context = service.context
    row = context.versions.get(ids[2])
    later = {**json.loads(row.document), "model_id": "a-second-version"}
    context.versions.add(json.dumps(later), "ONE", row.recording_id, "Ada", parent_id=row.id)
    answer = trend(client, "ONE")
    answers = answer["sessions"]
    assert [one["model_id"] for one in answers] == [ids[0], ids[1], "a-second-version"]
    assert [(one["approved"], one["versions"]) for one in answers] == [(True, 1), (False, 1), (False, 2)]
    assert answer["changes"]["sentences"] == ["Nothing changed beyond its uncertainty since 03 Aug 2026."]
    assert (answer["changes"]["differences"], answer["changes"]["since_model_id"]) == ([], ids[0]), "the approved one"
    assert "Nothing changed beyond" in client.get("/models/a-second-version", params={"diagnose": 0}).text
    context.versions.decide(ids[2], True, "Ada", "the first one")
    last = trend(client, "ONE")["sessions"][2]
    assert (last["model_id"], last["approved_by"]) == (ids[2], "Ada")
    context.versions.decide(ids[2], False, "Ada", "no, it is not")
    assert trend(client, "ONE")["sessions"][2]["model_id"] == "a-second-version"


def figure(value: float, sd: float, unit: str) -> dict[str, Any]:
    return {"value": value, "sd": sd, "unit": unit}


BEFORE = State({"plateau_nm": figure(5.0, 0.01, "N·m"), "time_constant_s": figure(0.5, 0.001, "s")},
               "maximum-likelihood", (), 20.0)  # fmt: skip
MORE = {"plateau_nm": figure(5.9, 0.01, "N·m"), "time_constant_s": figure(0.55, 0.001, "s")}


@pytest.mark.parametrize(
    ("now", "changed", "doubts"),
    [
        ({}, [], []),
        ({"figures": MORE}, ["plateau_nm", "time_constant_s"], []),
        ({"figures": MORE, "current_ma": 25.0, "notes": {"electrodes": "moved"}}, ["time_constant_s"],
         ["The current was 20.0\u00a0mA, now it is 25.0\u00a0mA: threshold and plateau are not compared.",
          "The notes on electrodes differ: “–”, then “moved”."]),
        ({"figures": MORE, "structure": ("fatigue:fitness",)}, [],
         ["The models' effects differ (none, then fatigue): only large differences are told."]),
    ],
)  # fmt: skip
def test_what_changed_and_what_is_in_doubt(now: dict[str, Any], changed: list[str], doubts: list[str]) -> None:
    state = replace(BEFORE, **now)
    assert sorted(change["figure"] for change in changes.changed(BEFORE, state)) == changed
    assert changes.doubt_sentences(BEFORE, state) == doubts
    other = replace(BEFORE, structure=("fatigue:two_pools",))
    again = changes.doubt_sentences(replace(other, structure=("fatigue:fitness",)), other)
    assert again[0].startswith("The models describe fatigue in different ways:")


def test_nobody_no_session_and_a_first_one(service: Service, client: httpx.Client) -> None:
    evil = '"><script>document.title="x"</script>'
    made(service, "NONE", [])
    made(service, "FIRST", [Planned(Patient(), 0.0, notes={"electrodes": evil}, current_ma=21.5)])
    assert client.get("/v1/participants/P999/trend").status_code == 404
    assert trend(client, "NONE") == {"participant": "NONE", "sessions": [], "changes": None}
    page = client.get("/participants/NONE/trend").text
    assert "No session with a model yet." in page and 'class="panel"' not in page
    (only,) = trend(client, "FIRST")["sessions"]
    assert only["figures"]["current_ma"] == {"value": 21.5, "sd": None, "uncertainty": None, "unit": "mA"}
    page = client.get("/participants/FIRST/trend").text
    assert "The trend begins with the second one." in page and page.count('class="panel"') == 9
    assert evil not in page and "&lt;script&gt;" in page


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
    assert changes.dose_words(12_345.6) == "12.35\u00a0mC" and changes.dose_words(None) == "–"


def test_a_panel_breaks_its_line_at_another_current_and_marks_what_is_noted() -> None:
    values = [(1.0, 0.1, 20.0), (1.1, 0.1, 20.0), (None, None, 20.0), (1.2, 0.1, 20.0), (2.0, 9.0, 25.0)]
    points = [Point(float(k), value, half, k != 1, k == 2, ma) for k, (value, half, ma) in enumerate(values)]
    drawn = history(points, "N·m", Axis("", (0.0, 4.0)), levels=[1.5, 99.0])
    line, bars, dots, hollow, flags = (mark for mark in drawn.marks if isinstance(mark, Line))
    assert line.y == [1.0, 1.1, None, 1.2, None, 2.0] and dots.y == [1.0, 1.1, 1.2, 2.0]
    assert bars.y[:3] == [0.9, 1.1, None] and (hollow.x, flags.x) == ([1.0], [2.0])
    assert [mark.at for mark in drawn.marks if isinstance(mark, Rule)] == [1.5]
    assert drawn.panels[0].limits is not None
    low, high = drawn.panels[0].limits
    assert low > -1.0 and high < 4.0, "one wide band does not dwarf the values"
