"""Whenever `serve` is told to end, or killed, none of its processes is left: each moment in a process group of its own.

They are found by a marker in their environment: `PATH`, which is passed on to workers, too.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.api.conftest import TOKEN
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import alive

pytestmark = [pytest.mark.wire, pytest.mark.slow]
LIMIT_S = 90.0
"""A machine that is busy or pauses takes long; only what is never true fails."""
BIRTH = """
import os, sys, time
from pathlib import Path
from stimrig.api.cli import supervisor

folder, when = Path(sys.argv[1]), sys.argv[2]
born = supervisor.die_with_parent

def held(*given):
    if when == "after":
        born(*given)
    (folder / "child").write_text(str(os.getpid()))
    parent = os.getppid()
    while os.getppid() == parent and not (folder / "go").exists():
        time.sleep(0.01)
    if when == "before":
        born(*given)

supervisor.die_with_parent = held
supervisor.on_endings(supervisor.raise_once)
supervisor.Child("child", ["sleep", "3600"], folder / "log").start()
time.sleep(3600)
"""
"""A child that is held between fork and exec, before or after the launcher has readied it."""


KILL = signal.SIGKILL


class Started:
    """A program of its own."""

    def __init__(self, name: str, *program: str) -> None:
        self.marker = f"/marker-{os.getpid()}-{name}-{time.monotonic_ns()}"
        given = {"PATH": f"{os.environ['PATH']}:{self.marker}", "STIMRIG_ADMIN_TOKEN": TOKEN, "STIMRIG_WORKERS": "1"}
        environment = {**os.environ, **given}
        self.process = subprocess.Popen(
            [sys.executable, *program], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip

    def line(self) -> str:
        """The next line of its standard output."""
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def left(self) -> list[int]:
        """Its processes that live."""
        found = []
        for place in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):  # another user's, or gone
                if self.marker.encode() in (place / "environ").read_bytes():
                    found.append(int(place.name))
        return found

    def killed(self) -> list[int]:
        """What is left of it when its group is killed and the others have had their time."""
        os.killpg(self.process.pid, KILL)
        self.process.communicate(timeout=LIMIT_S)
        left: list[int] = []
        end_s, looks = time.monotonic() + LIMIT_S, 0
        while looks < 3 and time.monotonic() < end_s:  # one that becomes another program has no environment just then
            left = self.left()
            looks = 0 if left else looks + 1
            time.sleep(0.05)
        for pid in left:
            os.kill(pid, KILL)
        return left


def test_a_running_test_is_sealed_although_the_launcher_is_killed(tmp_path: Path) -> None:
    """It says nothing to the rig any more: the kernel does."""
    served = Started("served", "-m", "stimrig", "serve", "--port", "0", "--data", str(tmp_path))
    url, _, control = served.line().split()[2], served.line(), served.line()
    assert Path(control.partition("the emulator's control line: ")[2]).is_socket()
    with httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=LIMIT_S) as http:
        http.post("/v1/participants", json={"code": "P1"})
        http.post("/v1/tests", json={"participant": "P1"})
        while not list(tmp_path.glob("journals/*")):
            time.sleep(0.05)
    assert served.killed() == []
    assert len(list(tmp_path.glob("recordings/*.h5"))) == 1


@pytest.mark.parametrize(("when", "killed"), [("before", "parent"), ("after", "parent"), ("before", "child")])
def test_no_end_is_lost_between_fork_and_exec(tmp_path: Path, when: str, killed: str) -> None:
    """There a child has the launcher's handlers still: what they hear, the program that it becomes never does."""
    parent = Started("parent", "-c", BIRTH, str(tmp_path), when)
    place, end_s = tmp_path / "child", time.monotonic() + LIMIT_S
    while not (place.exists() and place.read_text()):
        assert time.monotonic() < end_s and parent.process.poll() is None
        time.sleep(0.01)
    child = int(place.read_text())
    if killed == "child":
        os.kill(child, signal.SIGTERM)
        (tmp_path / "go").touch()
        while alive(child):
            assert time.monotonic() < end_s, "it became a program that nobody told"
            time.sleep(0.01)
    assert parent.killed() == []
