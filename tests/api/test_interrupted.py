"""Ctrl-C ends long work: the process is gone, its copies too, and no file is half-written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.api.conftest import soon
from tests.harness.processes import READY_TIMEOUT_S

BUSY = """
import signal, sys, time
from stimrig import identify
from stimrig.api.cli import main

def hold(*_, **__):
    print("computing", file=sys.stderr, flush=True)
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            pass

identify.explain = hold
main.main(sys.argv[1:])
"""
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
        process = subprocess.Popen([sys.executable, *map(str, words)], stdout=file, stderr=file, start_new_session=True)
    soon(lambda: said in log.read_text() or process.poll() is not None, READY_TIMEOUT_S)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=READY_TIMEOUT_S) == 130, log.read_text()
    return process.pid, log.read_text()


def test_ctrl_c_ends_a_verb_whatever_it_is_in(record: Path, tmp_path: Path) -> None:
    output = tmp_path / "out" / "MODEL.json"
    output.parent.mkdir()
    output.write_text("as it was")
    _, said = interrupted(tmp_path / "log", "computing", "-c", BUSY, "explain", record, "-o", output)
    assert "interrupted" in said and "Traceback" not in said
    assert output.read_text() == "as it was" and [path.name for path in output.parent.iterdir()] == ["MODEL.json"]


def test_ctrl_c_while_libraries_are_loaded_is_no_traceback(record: Path, tmp_path: Path) -> None:
    assert "Traceback" not in interrupted(tmp_path / "log", "loading", "-c", SLOW, record)[1]


def test_copies_of_a_search_end_with_it(record: Path, tmp_path: Path) -> None:
    watched = ("-X", "importtime", "-m", "stimrig", "explain", record)
    group, _ = interrupted(tmp_path / "log", "stimrig.identify.diagnosis.free", *watched)
    soon(lambda: all(_group(path) != group for path in Path("/proc").glob("[0-9]*")), READY_TIMEOUT_S)


def _group(process: Path) -> int:
    try:
        return int((process / "stat").read_text().rsplit(")", 1)[1].split()[2])
    except (OSError, IndexError):
        return 0
