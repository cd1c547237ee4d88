"""What the rig finds doubtful about a recording is said wherever a person looks at the test or its model."""

from __future__ import annotations

import json

import httpx

from stimrig.api.cli.session_report import report_lines
from stimrig.api.web.pages.report_file import comparison_html
from tests.api.conftest import Service, run_test

WORDS = [
    "load cell: stood at exactly 1.250 N·m through the whole test: is it stuck?",
    "load cell: 1560 samples/s came, the rig file says 1600: times of this recording are in doubt",
]


def test_warnings_are_told_on_every_page_and_in_the_terminal(
    client: httpx.Client, service: Service, participant: str
) -> None:
    sound = run_test(client, participant)
    service.rig.warnings = WORDS
    doubtful = run_test(client, participant)
    assert doubtful["summary"]["warnings"] == WORDS
    for done, told in ((sound, False), (doubtful, True)):
        model = json.loads(client.get(f"/v1/models/{done['model_id']}/file").text)
        shown = {
            path: client.get(path, headers={"Accept": "text/html"}).text
            for path in (
                f"/tests/{done['id']}", f"/models/{done['model_id']}", f"/models/{done['model_id']}/report",
            )
        }  # fmt: skip
        shown["terminal"] = "\n".join(report_lines(done, model))
        shown["file"] = comparison_html(
            model, client.get(f"/v1/models/{done['model_id']}/curves").json(), done["id"], done
        )
        for place, text in shown.items():
            for words in WORDS:
                assert (words in text) == told, (place, words)


def test_a_rig_that_knows_no_warnings_is_no_error(client: httpx.Client, service: Service, participant: str) -> None:
    """Summaries written before there were any."""
    done = run_test(client, participant)
    summary = {key: value for key, value in done["summary"].items() if key != "warnings"}
    model = json.loads(client.get(f"/v1/models/{done['model_id']}/file").text)
    assert not [line for line in report_lines({**done, "summary": summary}, model) if line.startswith("in doubt")]
