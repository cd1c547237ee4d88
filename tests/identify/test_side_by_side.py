"""Tasks shared by copies of this process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
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


@pytest.fixture(autouse=True)
def two_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WORKERS", 2)


def who(number: int) -> tuple[int, int]:
    time.sleep(0.06)
    return number * number, os.getpid()


def children() -> list[str]:
    return Path(f"/proc/{HERE}/task/{HERE}/children").read_text().split()


def test_every_task_is_done_once(monkeypatch):
    found = dict(side_by_side(who, 20))
    assert {number: square for number, (square, _) in found.items()} == {n: n * n for n in range(20)}
    processes = {process for _, process in found.values()}
    assert len(processes) == 2 and HERE not in processes
    monkeypatch.setattr(module, "WORKERS", 1)
    assert {process for _, (_, process) in side_by_side(who, 3)} == {HERE}


def test_a_copy_that_is_killed_loses_nothing():
    def fatal(number: int) -> int:
        if os.getpid() != HERE and number > 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return number

    assert dict(side_by_side(fatal, 9)) == {n: n for n in range(9)}


def test_an_error_of_a_task_is_raised_here():
    def fails(number: int) -> int:
        raise ZeroDivisionError(number)

    with pytest.raises(ZeroDivisionError):
        list(side_by_side(fails, 3))


def test_a_copy_does_not_wait_for_what_another_thread_compiles():
    held = threading.Event()

    def compiling() -> None:
        with global_compiler_lock:
            held.set()
            time.sleep(0.3)

    def locked(number: int) -> int:
        if os.getpid() != HERE:
            signal.alarm(5)
        with global_compiler_lock:
            return number

    other = threading.Thread(target=compiling)
    other.start()
    held.wait()
    pairs = list(side_by_side(lambda number: (locked(number), os.getpid()), 4))
    other.join()
    assert HERE not in {process for _, (_, process) in pairs}, "a copy that waited was ended by its alarm"


def test_who_stops_half_way_leaves_no_copy_behind():
    before = children()
    with pytest.raises(Cancelled):
        for number, _ in side_by_side(who, 50):
            if number >= 4:
                raise Cancelled("enough")
    assert children() == before


@pytest.mark.slow
def test_a_diagnosis_does_not_depend_on_who_did_what(monkeypatch):
    record = hidden_muscles.record("fatigue", seed=11, rate_hz=100)
    with few_effects.only("fatigue", "output_saturation"):
        by_copies = diagnose(record).to_dict()
        monkeypatch.setattr(module, "WORKERS", 1)
        assert diagnose(record).to_dict() == by_copies


def test_a_copy_ends_with_its_parent_in_the_middle_of_a_task(tmp_path: Path) -> None:
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from stimrig.identify.diagnosis import side_by_side as module\n"
        "module.WORKERS = 2\n"
        "def work(number):\n"
        "    (Path(sys.argv[1]) / str(os.getpid())).touch()\n"
        "    time.sleep(3600)\n"
        "list(module.side_by_side(work, 2))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) as parent:
        while len(copies := [int(file.name) for file in tmp_path.iterdir()]) < 2:
            assert parent.poll() is None
            time.sleep(0.02)
        parent.kill()
    for copy in copies:
        for _ in range(3000):
            if not Path(f"/proc/{copy}/stat").exists() or " Z " in Path(f"/proc/{copy}/stat").read_text():
                break
            time.sleep(0.02)
        else:
            os.kill(copy, signal.SIGKILL)
            pytest.fail("it outlived its parent by a minute")
