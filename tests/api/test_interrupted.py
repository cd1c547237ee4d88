"""Ctrl-C ends long work: the process is gone, its copies too, and no file is half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.harness.processes import READY_TIMEOUT_S

BUSY = """
import signal, sys, time
from stimrig import identify
from stimrig.api.cli import main

def hold(*_, **__):
    print("computing", file=sys.stderr, flush=True)
    {hold}

identify.{function} = hold
main.main(sys.argv[1:])
"""
DEAF = "while True:\n        try:\n            time.sleep(60)\n        except KeyboardInterrupt:\n            pass"
"""As a library that calls us from its C code: the exception is dropped."""


SLOW = """
import sys, time

class Slow:
    def find_spec(name, *_):
        if name == "numpy":
            print("loading", file=sys.stderr, flush=True)
            time.sleep(600)

sys.meta_path.insert(0, Slow)
sys.argv = ["stimrig", "diagnose", sys.argv[1]]
from stimrig.__main__ import main
main()
"""


def interrupted(log: Path, said: str, *words: object) -> tuple[int, str]:
    """Begin a command, interrupt it once it has said something; its process group, and all that it said."""
    with log.open("wb") as file:
        process = subprocess.Popen(list(map(str, words)), stdout=file, stderr=file, start_new_session=True)
    end = time.monotonic() + READY_TIMEOUT_S
    while said not in log.read_text():
        assert time.monotonic() < end and process.poll() is None, log.read_text()
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=READY_TIMEOUT_S) == 130, log.read_text()
    return process.pid, log.read_text()


@pytest.mark.parametrize(("verb", "hold"), [("diagnose", DEAF), ("explain", "time.sleep(600)")])
def test_ctrl_c_ends_a_verb_whatever_it_is_in(record: Path, tmp_path: Path, verb: str, hold: str) -> None:
    output = tmp_path / "out" / "MODEL.json"
    output.parent.mkdir()
    output.write_text("as it was")
    options = () if verb == "diagnose" else ("-o", output)
    code = BUSY.format(function=verb, hold=hold)
    log = tmp_path / "log"
    _, said = interrupted(log, "computing", sys.executable, "-c", code, verb, record, *options)
    assert "interrupted" in said and "Traceback" not in said
    assert output.read_text() == "as it was" and [path.name for path in output.parent.iterdir()] == ["MODEL.json"]


def test_ctrl_c_while_libraries_are_loaded_is_no_traceback(record: Path, tmp_path: Path) -> None:
    assert "Traceback" not in interrupted(tmp_path / "log", "loading", sys.executable, "-c", SLOW, record)[1]


def test_copies_of_a_search_end_with_it(record: Path, tmp_path: Path) -> None:
    watched = (sys.executable, "-X", "importtime", "-m", "stimrig", "explain", record)
    group, _ = interrupted(tmp_path / "log", "stimrig.identify.diagnosis.free", *watched)
    end = time.monotonic() + READY_TIMEOUT_S
    while any(_group(path) == group for path in Path("/proc").glob("[0-9]*")):
        assert time.monotonic() < end
        time.sleep(0.05)


def _group(process: Path) -> int:
    try:
        return int((process / "stat").read_text().rsplit(")", 1)[1].split()[2])
    except (OSError, IndexError):
        return 0
