"""`make pauses`: processes really stand still, each on its own or all at once, and none stays stopped."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.harness import pauses
from tests.harness.paced_time import conductor
from tests.harness.paced_time.conductor import states_of
from tests.harness.pauses import LONGEST_S, SHARE, SHORTEST_S, below, pattern

ROOT = Path(__file__).parents[1]
BEAT_S = 0.005
LIVES = """
import pathlib, subprocess, sys, time
name, *rest, lasts_s = sys.argv[1:]
if rest:  # a child, whose child is an orphan in a session of its own
    subprocess.Popen([sys.executable, "-c", sys.orig_argv[2], *rest, lasts_s], start_new_session=True)
if name == "between":
    sys.exit()
with open(name, "a", buffering=1) as file:
    end_s = time.monotonic() + float(lasts_s)
    while time.monotonic() < end_s:
        print(time.monotonic(), file=file)
        time.sleep(0.005)
"""
PATIENCE_S = 60.0


@pytest.fixture
def disturb(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """A process and an orphan of it, which write when they live, under the disturber."""
    begun: list[subprocess.Popen[str]] = []

    def begin(lasts_s: float) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", LIVES, str(tmp_path / "first"), "between", str(tmp_path / "orphan")]
        disturber = [sys.executable, "-m", "tests.harness.pauses", "--seed", "5", "--share", "0.5", "--"]
        process = subprocess.Popen(
            [*disturber, *command, str(lasts_s)], cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        begun.append(process)
        return process

    yield begin
    for process in begun:
        tree = below(process.pid)
        process.kill()
        process.communicate()
        for pid in tree:
            if "Z" not in states_of(pid):
                os.kill(pid, signal.SIGKILL)


def gaps(path: Path) -> list[tuple[float, float]]:
    """When a process stood still."""
    times = [float(line) for line in path.read_text().splitlines()]
    return [pair for pair in itertools.pairwise(times) if pair[1] - pair[0] > 0.8 * SHORTEST_S]


def until(holds: Callable[[], bool]) -> None:
    """Wait for something."""
    end_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(BEAT_S)


def lives_on(path: Path) -> bool:
    """Whether a process writes again."""
    before = path.stat().st_size
    until(lambda: path.stat().st_size > before)
    return True


def test_the_pattern_is_the_seed_s_and_stops_five_percent_of_the_time() -> None:
    first = list(itertools.islice(pattern(7), 4000))
    assert first == list(itertools.islice(pattern(7), 4000)) != list(itertools.islice(pattern(8), 4000))
    paused_s, between_s = sum(pause.duration_s for pause in first), sum(pause.after_s for pause in first)
    assert paused_s / (paused_s + between_s) == pytest.approx(SHARE, rel=0.1)
    assert min(pause.duration_s for pause in first) >= SHORTEST_S
    assert max(pause.duration_s for pause in first) <= LONGEST_S
    assert sum(pause.which is None for pause in first) == pytest.approx(2000, rel=0.1)


def test_share_and_bounds_of_the_pauses_can_be_given() -> None:
    drawn = list(itertools.islice(pattern(7, 0.2, 0.02, 0.3), 4000))
    paused_s, between_s = sum(pause.duration_s for pause in drawn), sum(pause.after_s for pause in drawn)
    assert paused_s / (paused_s + between_s) == pytest.approx(0.2, rel=0.1)
    assert 0.02 <= min(pause.duration_s for pause in drawn) < 0.03
    assert 0.29 < max(pause.duration_s for pause in drawn) <= 0.3
    assert {len(pause.of([1, 2, 3])) for pause in drawn} == {1, 3}


@pytest.mark.slow
def test_processes_and_their_orphans_stand_still_as_often_as_is_told(
    tmp_path: Path, disturb: Callable[..., subprocess.Popen[str]]
) -> None:
    out, _ = disturb(8.0).communicate(timeout=PATIENCE_S)
    begins, last = out.splitlines()[0], out.splitlines()[-1]
    told = re.fullmatch(r"pauses: (\d+), ([\d.]+) s in all, SEED=5; the suite was green", last)
    assert "SEED=5" in begins and told
    wanted = list(itertools.islice(pattern(5, 0.5), int(told[1])))[:-1]  # the last may have been cut short
    at_once = [pause.duration_s for pause in wanted if pause.which is None]
    assert 0 < len(at_once) < len(wanted)
    first, orphan = gaps(tmp_path / "first"), gaps(tmp_path / "orphan")
    for stood in (first, orphan):  # what stops all stops each of them
        assert max(after - before for before, after in stood) >= max(at_once)
    together = [pair for pair in first if any(other[0] < pair[1] and pair[0] < other[1] for other in orphan)]
    assert 0 < len(together) < max(len(first), len(orphan)), "sometimes both, sometimes one"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=["killed", "told to end"])
def test_nothing_stays_stopped_when_the_disturber_ends(
    tmp_path: Path, disturb: Callable[..., subprocess.Popen[str]], number: int
) -> None:
    process = disturb(PATIENCE_S)
    orphan = tmp_path / "orphan"
    until(orphan.exists)

    def stopped() -> list[int]:
        return [pid for pid in tree if "T" in states_of(pid)]

    tree = below(process.pid)
    until(lambda: bool(stopped()))
    process.send_signal(number)
    until(lambda: not stopped())
    assert lives_on(orphan)
    for _ in range(5):  # nor is it stopped again
        assert lives_on(orphan) and not stopped()
    for pid in tree:
        if states_of(pid) - {"Z"}:
            os.kill(pid, signal.SIGKILL)


def test_time_waits_for_what_the_disturber_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pauses.VARIABLE == conductor.PAUSED
    monkeypatch.setenv(conductor.PAUSED, str(tmp_path))
    (tmp_path / "17").touch()
    assert conductor.paused(17) and not conductor.paused(18)
