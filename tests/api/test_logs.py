"""Log lines of every process: whatever is written is one JSON object a line, with the fields of the docs."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from stimrig.api.store import Store
from stimrig.api.store.tables import Participant
from tests.api.test_operation_wire import ALWAYS, documented

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


@pytest.mark.parametrize(("module", "process"), [("stimrig.api", "worker"), ("stimrig.rig", "lsl")])
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
    call = json.dumps({"call": 1, "verb": "no such verb", "arguments": {}})
    command = [sys.executable, "-m", "stimrig.api.workers.child"]
    done = subprocess.run(command, input=call + "\n", capture_output=True, text=True)
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
