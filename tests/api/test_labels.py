"""A label of a test is said in one place, and each door takes it and shows it; CONTRIBUTING says how one is added."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from stimrig.api.cli.commands.test import take_labels
from stimrig.api.cli.session_report import report_lines
from stimrig.api.client.documents import SessionTest
from stimrig.api.cohort.export import Days, hidden
from stimrig.api.cohort.record import SAID
from stimrig.api.cohort.select import FIELDS
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.sessions.requests import TestIn
from stimrig.api.web.responses.rig import TestOut
from stimrig.rig.messages import LABEL_TITLES, LABELS, Labels, TestPlan
from tests.api.conftest import QUICK_SPEED, Service, csrf, shared_service, signed_in, wait_done

service = shared_service()


@pytest.fixture
def titled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kind of a test, as if it were a label that people type."""
    monkeypatch.setitem(LABEL_TITLES, "kind", "Posture")


@pytest.mark.parametrize("name", LABELS)
def test_every_document_and_every_table_has_it(name: str) -> None:
    assert all(name in model.model_fields for model in (TestIn, TestPlan, TestOut))
    assert name in SessionTest.__annotations__ and Labels.model_fields[name].description
    assert FIELDS[name].attribute == name and name in SAID
    pytest.importorskip("pyarrow")
    from stimrig.api.cohort import table
    from stimrig.api.exchange.outward import bids, parquet

    assert {name} <= set(table.SCHEMA.names) & set(parquet.SCHEMAS["records"].names)
    assert name in bids.SCANS or name == "participant"


def test_the_docs_list_them() -> None:
    text = (Path(__file__).parents[2] / "docs" / "recording.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \|$", text.partition("### Labels")[2].partition("### Events")[0], re.M)
    assert rows == [(name, field.description) for name, field in Labels.model_fields.items()]


def test_a_label_stands_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"U\+202E"):
        TestIn._one_line("left\u202earm")
    assert TestIn._one_line(" lies ") == "lies" and TestIn._one_line(None) is None


@pytest.mark.usefixtures("titled")
def test_a_person_types_it_and_reads_it_on_every_page(service: Service) -> None:
    service.rig.speed = QUICK_SPEED
    with service.client() as http, signed_in(service) as browser:
        http.post("/v1/participants", json={"code": "L1"})
        seen = http.get("/v1/participants/L1").headers["etag"].strip('"')
        assert '<label class="target">Posture <input name="kind"' in browser.get("/participants/L1").text
        form = {"csrf": csrf(browser), "seen": seen, "kind": " next-experiment "}
        question = browser.post("/participants/L1/tests", data=form).headers["location"]
        assert re.search(r"Posture</th><td>(<b>)?next-experiment", browser.get(question).text)
        started = browser.post(question, data={"csrf": csrf(browser)}).headers["location"]
        test = wait_done(http, started.rpartition("/")[2])
        model = http.get(f"/v1/models/{test['model_id']}/file").json()
        told = report_lines(test, model)
        assert "posture        next-experiment" in told
        dose = re.search(r"<dt>Dose</dt><dd>(\S+ mC)", browser.get(started).text.replace("\u00a0", " "))
        assert dose and f"dose           {dose[1]} a phase" in "\n".join(told).replace("\u00a0", " "), "in one unit"
        for page, words in (
            (started, '<dt>Posture</dt><dd translate="no">next-experiment</dd>'),
            ("/participants/L1", '<span class="dim" title="Posture" translate="no">next-experiment</span>'),
            (f"{test['model_url'].removeprefix('/v1')}/report", "<tr><th>Posture</th><td colspan"),
        ):
            assert words in browser.get(page).text
            in_german = browser.get(page, headers={"Accept-Language": "de"}).text
            assert words.replace("Posture", "Körperhaltung") in in_german


@pytest.mark.usefixtures("titled")
def test_the_command_line_takes_it() -> None:
    given: list[dict[str, Any]] = []

    def verb(often: int = 1, **labels: str | None) -> None:
        given.append({"often": often, **labels})

    take_labels(verb)
    app = typer.Typer(rich_markup_mode=None)
    app.command()(verb)
    for words in (["--often", "2"], ["--kind", "next-experiment"]):
        assert CliRunner().invoke(app, words).exit_code == 0
    none = dict.fromkeys(LABEL_TITLES)
    assert given == [{**none, "often": 2}, {**none, "often": 1, "kind": "next-experiment"}]
    assert "kind of test" in CliRunner().invoke(app, ["--help"]).stdout


@pytest.mark.usefixtures("titled")
def test_what_a_person_typed_goes_with_the_days_of_an_export() -> None:
    record = WholeRecord("", {"participant": "P1", "kind": "after lunch on Monday"}, {})
    assert hidden(record, Days(hide=True)).about == hidden(record, Days(shift_days=3)).about == {"participant": "P1"}
    assert hidden(record, Days()).about == record.about
