"""Whenever `serve` is told to end, or killed, none of its processes is left: each moment in a process group of its own.

They are found by a marker in their environment: `PATH`, which is passed on to workers, too. So that twenty start in
seconds, the service is a stand-in; launcher, emulator and rig are those that people run.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.api.conftest import TOKEN
from tests.harness.looks_first import LooksFirst
from tests.harness.processes import alive

pytestmark = [pytest.mark.wire, pytest.mark.slow]
LIMIT_S = 90.0
"""A machine that is busy or pauses takes long; only what is never true fails."""
SIDE_BY_SIDE = 3
SERVE = ("serve", "--port", "0")
SERVICE = """
import json, time
print(json.dumps({"url": "http://127.0.0.1:1", "port": 1, "drawn_token": None}), flush=True)
time.sleep(3600)
"""
QUICK = f"""
import sys
from unittest.mock import MagicMock

sys.modules["stimrig.api.store.migrations"] = MagicMock()  # serve opens no database; loading these is half of its start
from stimrig.api.cli import launcher, main

made = launcher.Services._child

def child(self, name, module):
    found = made(self, name, module)
    if name == "api":
        found.command = [sys.executable, "-c", {SERVICE!r}]
    return found

launcher.Services._child = child
main.main()
"""
BIRTH = """
import os, sys, time
from pathlib import Path
from stimrig.api.cli import child, launcher

folder, when = Path(sys.argv[1]), sys.argv[2]
born = child.die_with_parent

def held(*given):
    if when == "after":
        born(*given)
    (folder / "child").write_text(str(os.getpid()))
    parent = os.getppid()
    while os.getppid() == parent and not (folder / "go").exists():
        time.sleep(0.01)
    if when == "before":
        born(*given)

child.die_with_parent = held
with launcher.Endings():
    child.Child("child", ["sleep", "3600"], folder / "log").start()
    time.sleep(3600)
"""
"""A child that is held between fork and exec, before or after the launcher has readied it."""


@dataclass(frozen=True)
class Moment:
    """A signal at a share of the start-up; another one at a share of the shutdown that follows."""

    first: signal.Signals
    at: float
    second: signal.Signals | None = None
    later: float = 0.0


TERM, INT, KILL = signal.SIGTERM, signal.SIGINT, signal.SIGKILL
MOMENTS = [
    *(Moment(TERM, share) for share in (0.0, 0.1, 0.3, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.8, 0.9, 1.0)),
    *(Moment(KILL, share) for share in (0.5, 0.6, 0.75, 0.9)),
    *(Moment(TERM, 1.0, second, later) for second, later in ((TERM, 0.2), (INT, 0.5), (KILL, 0.1), (KILL, 0.7))),
    Moment(INT, 0.6, INT, 0.3),
]


class Started:
    """A program of its own: `serve` with the stand-in, or another one."""

    def __init__(self, folder: Path, name: str, *program: str) -> None:
        self.folder, self.marker = folder / name, f"/marker-{os.getpid()}-{name}-{time.monotonic_ns()}"
        environment = {**os.environ, "PATH": f"{os.environ['PATH']}:{self.marker}", "STIMRIG_ADMIN_TOKEN": TOKEN}
        given = program or ("-c", QUICK, *SERVE, "--data", str(self.folder))
        self.process = subprocess.Popen(
            [sys.executable, *given], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip

    def url(self) -> str:
        """Its address, once all has started."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("stimrig serves"), (line, self.process.communicate())
        return line.split()[2]

    def tell(self, number: signal.Signals) -> None:
        """To its whole process group; it may have ended by itself."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)

    def left(self) -> dict[int, str]:
        """Its processes that live, with their commands."""
        found = {}
        for place in Path("/proc").glob("[0-9]*"):
            try:
                if self.marker.encode() in (place / "environ").read_bytes():
                    found[int(place.name)] = (place / "cmdline").read_text().replace("\0", " ")
            except OSError:  # another user's, or gone
                continue
        return found

    def ended(self) -> dict[int, str]:
        """What is left of it when it has ended and the others have had their time."""
        left: dict[int, str] = {}
        self.process.communicate(timeout=LIMIT_S)
        end_s, looks = time.monotonic() + LIMIT_S, 0
        while looks < 3 and time.monotonic() < end_s:  # one that becomes another program has no environment just then
            left = self.left()
            looks = 0 if left else looks + 1
            time.sleep(0.05)
        for pid in left:
            os.kill(pid, KILL)
        return left


@pytest.mark.campaign
def test_nothing_is_left_whenever_it_is_told_to_end(tmp_path: Path) -> None:
    began_s = time.monotonic()
    served = Started(tmp_path, "measured")
    served.url()
    ready_s = time.monotonic()
    assert len(served.left()) >= 4, "serve, emulator, rig and service bear the marker"
    served.tell(TERM)
    assert served.ended() == {}
    assert served.process.returncode == 0
    start_s, end_s = ready_s - began_s, time.monotonic() - ready_s

    def play(number: int) -> dict[int, str]:
        moment, served = MOMENTS[number], Started(tmp_path, str(number))
        if moment.at == 1.0:
            served.url()
        else:
            time.sleep(moment.at * start_s)
        served.tell(moment.first)
        if moment.second is not None:
            time.sleep(moment.later * end_s)
            served.tell(moment.second)
        return served.ended()

    with ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        left = dict(zip(MOMENTS, pool.map(play, range(len(MOMENTS))), strict=True))
    assert {moment: processes for moment, processes in left.items() if processes} == {}


def test_a_running_test_is_sealed_although_the_launcher_is_killed(tmp_path: Path) -> None:
    """It says nothing to the rig any more: the kernel does."""
    served = Started(tmp_path, "served", "-m", "stimrig", *SERVE, "--data", str(tmp_path / "served"))
    url, said = served.url(), served.process.stdout
    assert said is not None and said.readline()
    control = said.readline().partition("the emulator's control line: ")[2].strip()
    assert Path(control).is_socket()
    with httpx.Client(base_url=url, auth=LooksFirst(TOKEN), timeout=LIMIT_S) as http:
        http.post("/v1/participants", json={"code": "P1"})
        http.post("/v1/tests", json={"participant": "P1"})
        while not (found := list(served.folder.glob("journals/*"))):
            time.sleep(0.05)
    served.tell(KILL)
    assert served.ended() == {}
    assert found and len(list(served.folder.glob("recordings/*.h5"))) == 1


@pytest.mark.parametrize(("when", "killed"), [("before", "parent"), ("after", "parent"), ("before", "child")])
def test_no_end_is_lost_between_fork_and_exec(tmp_path: Path, when: str, killed: str) -> None:
    """There a child has the launcher's handlers still: what they hear, the program that it becomes never does."""
    parent = Started(tmp_path, "parent", "-c", BIRTH, str(tmp_path), when)
    place, end_s = tmp_path / "child", time.monotonic() + LIMIT_S
    while not (place.exists() and place.read_text()):
        assert time.monotonic() < end_s and parent.process.poll() is None
        time.sleep(0.01)
    child = int(place.read_text())
    if killed == "child":
        os.kill(child, TERM)
        (tmp_path / "go").touch()
        while alive(child):
            assert time.monotonic() < end_s, "it became a program that nobody told"
            time.sleep(0.01)
    parent.tell(KILL)
    assert parent.ended() == {}
