"""Log lines are JSON objects with the fields of the docs; figures of /metrics stand there and tell of nobody."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from stimrig.api.cli.supervisor import LAST_BYTES, Child
from stimrig.api.store import Store
from stimrig.api.store.tables import Participant
from tests.api.conftest import Service, run_test

DOCS = Path(__file__).parents[2] / "docs" / "operation.md"
ALWAYS = {"time", "level", "process", "logger", "message"}

SAYS = """
import logging, threading, warnings
from {module} import logs
logs.configure("{process}")
logging.getLogger("a").info("two\\nlines and %s", "words")
logging.getLogger("a").warning("of a test", extra={{"test_id": "t1"}})
warnings.warn("old")
try:
    1 / 0
except ZeroDivisionError:
    logging.getLogger("a").exception("broken")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
raise ValueError("the end")
"""


def documented() -> set[str]:
    """The fields of log lines."""
    rows = DOCS.read_text("utf-8").partition("| field | is |")[2].partition("\n\n")[0].splitlines()[2:]
    return {name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])}


def check_log_lines(folder: Path, test_id: str, secrets: tuple[str, ...]) -> None:
    """Assert that every line of rig and service is an object with the fields of the docs and holds no secret."""
    found = [line for path in folder.glob("*.log") for line in path.read_text("utf-8").splitlines()]
    lines = [json.loads(line) for line in found]
    assert all(set(line) >= ALWAYS and set(line) <= documented() for line in lines)
    assert not [line for line in found for word in secrets if word in line]
    assert {line["process"] for line in lines if line.get("test_id") == test_id} >= {"service", "rig"}
    assert any("uvicorn" in line["logger"] for line in lines), "uvicorn's own lines, too"
    (start,) = (line for line in lines if line["message"].startswith("test requested"))
    assert start["test_id"] == test_id and start["request_id"], "a line names the request that it comes of"


@pytest.mark.parametrize(("module", "process"), [("stimrig.api", "worker"), ("stimrig.rig", "rig")])
def test_every_line_is_an_object_also_of_what_ends_the_process(module: str, process: str) -> None:
    code = SAYS.format(module=module, process=process)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    found = [json.loads(line) for line in done.stderr.splitlines()]
    assert done.returncode == 1
    assert all(set(line) >= ALWAYS and set(line) <= documented() for line in found)
    assert {line["process"] for line in found} == {process}
    assert [line["message"].split("\n")[0] for line in found[:2]] == ["two", "of a test"] and found[1][
        "test_id"
    ] == "t1"
    assert "old" in found[2]["message"]
    assert "ZeroDivisionError" in found[3]["exception"] and "ZeroDivisionError" in found[4]["exception"]
    assert "the end" in found[-1]["exception"]


def test_a_worker_that_fails_says_so_in_such_a_line() -> None:
    code = "from stimrig.api import logs; from stimrig.api.jobs.child import answer; logs.configure('worker')"
    code += "; answer('stimrig.api.jobs.verbs', 'no such verb', None, {})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    [line] = [json.loads(line) for line in done.stderr.splitlines()]
    assert (line["process"], line["level"]) == ("worker", "error") and "KeyError" in line["exception"]


def test_an_error_of_the_database_names_no_participant(tmp_path) -> None:
    store = Store(f"sqlite:///{tmp_path / 'a.db'}")
    with pytest.raises(Exception, match="UNIQUE") as told:
        for _ in range(2):
            with store.write() as session:
                session.add(Participant(code="P017-secret", profile={}, created_utc="", created_by="Anna"))
    assert "P017" not in str(told.value) and "Anna" not in str(told.value)
    store.close()


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (None, ""), ("", ""), ("rig: no room\n", "rig: no room"), ('rig: no\n{"level": "info", "message": "x"}\n', ""),
        ('{"level": "info", "message": "all went well"}\n', ""), ('{"level": "error", "message": "gone"}\n', "gone"),
        ('{"time": "2026-11-23T08:0', ""), ('{"level": "info"}\n', ""), ("{" * 100_000, ""),
        ("x" * 3 * LAST_BYTES + "\nrig: gone\n", "rig: gone"),
    ],
)  # fmt: skip
def test_the_last_words_of_a_process_are_its_own_last_line(tmp_path: Path, log: str | None, words: str) -> None:
    if log is not None:
        (tmp_path / "rig.log").write_text(log)
    assert Child("rig", [], tmp_path / "rig.log").last_words() == words


# ---- The figures of `/metrics` tell of stops and the rig, and nothing of anybody -------------------------------------


def exported(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    """Samples by name."""
    found: dict[str, list[tuple[dict[str, str], float]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def test_every_figure_stands_in_the_docs_and_tells_nothing_of_anybody(
    service: Service, client: httpx.Client, participant: str
) -> None:
    service.rig_thread.rig.more_summary = {"ack_delay_ms": {"median": 1.1, "p99": 1.9, "max": 2.4}}
    run_test(client, participant)
    client.post("/v1/stop", json={"reason": "typed by a person"})
    text = client.get("/metrics", headers={"Authorization": ""}).text
    there = exported(text)
    assert there["stimrig_stops_total"] == [
        ({"outcome": "confirmed"}, 1.0), ({"outcome": "not-confirmed"}, 0.0), ({"outcome": "failed"}, 0.0)
    ]  # fmt: skip
    assert there["stimrig_stop_confirmation_seconds_count"] == [({}, 1.0)]
    assert [labels["state"] for labels, value in there["stimrig_rig_state"] if value] == ["latched"]
    assert {labels["quantile"] for labels, _ in there["stimrig_pulse_lateness_seconds"]} == {"0.5", "0.99", "1"}
    assert participant not in text and "typed by" not in text
    assert participant not in client.get("/health", headers={"Authorization": ""}).text
    labels = {key for samples in there.values() for one, _ in samples for key in one}
    assert labels == {"state", "outcome", "quantile", "version", "le"}
    page = (Path(__file__).parents[2] / "docs" / "operation.md").read_text("utf-8")
    families = [one.name for one in text_string_to_metric_families(text)]
    assert [name for name in families if f"`{name}" not in page] == []
