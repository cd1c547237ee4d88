"""Tasks shared between this process and its copies."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from numba.core.compiler_lock import global_compiler_lock

from stimrig.identify.diagnosis import diagnose
from stimrig.identify.diagnosis import side_by_side as module
from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.errors import Cancelled
from tests.harness import few_effects
from tests.identify import hidden_muscles

HERE = os.getpid()


def who(number: int) -> tuple[int, int]:
    time.sleep(0.06)
    return number * number, os.getpid()


def children() -> list[str]:
    return Path(f"/proc/{HERE}/task/{HERE}/children").read_text().split()


@pytest.mark.parametrize("processes", [1, 2, 3])
def test_every_task_is_done_once(processes):
    found = dict(side_by_side(who, 40, processes))
    assert {number: square for number, (square, _) in found.items()} == {n: n * n for n in range(40)}
    assert len({process for _, process in found.values()}) == processes


def test_a_copy_that_is_killed_loses_nothing():
    def fatal(number: int) -> int:
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.02)
        return number

    assert dict(side_by_side(fatal, 9, 2)) == {n: n for n in range(9)}


def test_a_copy_that_ends_within_a_result_loses_nothing(monkeypatch):
    def half(results: Connection, result: object) -> None:
        os.write(results.fileno(), struct.pack("!i", 1000) + bytes(500))
        os.kill(os.getpid(), signal.SIGKILL)

    def slow(number: int) -> int:
        time.sleep(0.02)
        return number

    monkeypatch.setattr(Connection, "send", half)
    assert dict(side_by_side(slow, 9, 2)) == {n: n for n in range(9)}


def test_a_copy_does_not_wait_for_what_another_thread_compiles():
    held = threading.Event()

    def compiling() -> None:
        with global_compiler_lock:
            held.set()
            time.sleep(0.3)

    def locked(number: int) -> int:
        time.sleep(0.02)
        if os.getpid() != HERE:
            signal.alarm(5)
        with global_compiler_lock:
            return os.getpid()

    other = threading.Thread(target=compiling)
    other.start()
    held.wait()
    began = time.monotonic()
    found = dict(side_by_side(locked, 9, 2))
    other.join()
    assert len(set(found.values())) == 2
    assert time.monotonic() - began < 4.0


def test_who_stops_half_way_leaves_no_copy_behind():
    before = children()
    with pytest.raises(Cancelled):
        for number, _ in side_by_side(who, 50, 2):
            if number >= 4:
                raise Cancelled("enough")
    assert children() == before


def test_results_longer_than_a_pipe_arrive_whole():
    found = dict(side_by_side(lambda number: bytes(3_000_000) + bytes([number]), 6, 2))
    assert sorted(found) == list(range(6))
    assert all(len(value) == 3_000_001 and value[-1] == number for number, value in found.items())


@pytest.mark.slow
def test_a_diagnosis_does_not_depend_on_who_did_what(monkeypatch):
    record = hidden_muscles.record("fatigue", seed=11)
    with few_effects.only("fatigue", "output_saturation", "potentiation", "threshold_drift"):
        by_default = diagnose(record).to_dict()
        monkeypatch.setattr(module, "WORKERS", 2 if module.WORKERS == 1 else 1)
        assert diagnose(record).to_dict() == by_default


def test_a_copy_ends_with_its_parent_in_the_middle_of_a_task(tmp_path: Path) -> None:
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from stimrig.identify.diagnosis.side_by_side import side_by_side\n"
        "def work(number):\n"
        "    (Path(sys.argv[1]) / str(os.getpid())).touch()\n"
        "    time.sleep(3600)\n"
        "list(side_by_side(work, 2, 2))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) as parent:
        while len(begun := [int(file.name) for file in tmp_path.iterdir()]) < 2:
            assert parent.poll() is None
            time.sleep(0.02)
        parent.kill()
    (copy,) = set(begun) - {parent.pid}
    for _ in range(3000):
        if not Path(f"/proc/{copy}/stat").exists() or " Z " in Path(f"/proc/{copy}/stat").read_text():
            return
        time.sleep(0.02)
    os.kill(copy, signal.SIGKILL)
    pytest.fail("it outlived its parent by a minute")
