"""The LSL outlets beside the service: told when they die, started again, and never more than that."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.api.cli import launcher
from stimrig.api.cli.child import LAST_BYTES, Child
from stimrig.api.cli.launcher import Services, Streams
from stimrig.api.settings import Settings
from tests.harness.lsl_recorder import on_this_machine


class FakeChild:
    """As the launcher's `Child`, without a process."""

    def __init__(self, words: str = "lsl: broken", starts: bool = True) -> None:
        self.command: list[str] = []
        self.process: Any = None
        self.started_s, self.starts, self.ends, self.words, self.works = 0.0, 0, 0, words, starts

    def start_unheard(self) -> None:
        self.starts += 1
        self.started_s = time.monotonic()
        self.process = SimpleNamespace(code=None) if self.works else None
        if self.process is not None:
            self.process.poll = lambda process=self.process: process.code

    def die(self, code: int) -> None:
        self.process.code = code

    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def end(self) -> None:
        self.ends += 1

    def last_words(self) -> str:
        return self.words


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr(launcher, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    return clock


def test_a_death_is_told_once_and_it_is_started_again_at_longer_intervals(clock: SimpleNamespace) -> None:
    child = FakeChild()
    streams = Streams(child)
    streams.start(["--config", "rig.toml"], "data")
    assert child.command == ["--config", "rig.toml", "--data", "data"]
    for wait_s in (1.0, 5.0, 30.0, 30.0):
        child.started_s = clock.now_s
        assert streams.watch() == []
        child.die(1)
        starts = child.starts
        told = streams.watch()
        assert len(told) == 1 and "broken" in told[0] and "all else goes on" in told[0]
        clock.now_s += wait_s - 0.01
        assert streams.watch() == [] and child.starts == starts
        clock.now_s += 0.02
        assert streams.watch() == [] and child.starts == starts + 1


def test_where_the_library_is_missing_it_is_said_once_and_given_up(clock: SimpleNamespace) -> None:
    child = FakeChild("lsl: pylsl is not there; pip install 'stimrig[lsl]'")
    streams = Streams(child)
    streams.start([], "data")
    child.die(2)
    told = streams.watch()
    assert len(told) == 1 and "pip install" in told[0]
    clock.now_s += 1000
    assert streams.watch() == [] and child.starts == 1


def test_a_process_that_cannot_be_made_ends_nothing(clock: SimpleNamespace) -> None:
    child = FakeChild(starts=False)
    streams = Streams(child)
    streams.start([], "data")
    assert "could not be started" in streams.watch()[0]


def test_it_is_off_unless_it_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STIMRIG_LSL", raising=False)
    assert Services(Settings(data_dir=tmp_path)).lsl is None
    monkeypatch.setenv("STIMRIG_LSL", "true")
    assert Services(Settings(data_dir=tmp_path)).lsl is not None


@pytest.mark.wire
@pytest.mark.slow
def test_killed_beside_the_service_it_comes_back_and_the_service_goes_on(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, port=0, lsl=True)
    with on_this_machine(tmp_path), Services(settings, ["--speed", "2"], "administrator-token-of-a-test") as services:
        assert services.lsl is not None
        process = services.lsl.child.process
        assert process is not None
        process.kill()
        process.wait()
        told: list[str] = []
        end_s = time.monotonic() + 60
        while not services.lsl.child.alive() or services.lsl.child.process is process:
            told += services.watch()
            assert time.monotonic() < end_s
            time.sleep(0.05)
        assert len([line for line in told if line.startswith("lsl had ended")]) == 1
        assert services.api.alive() and services.rig.alive()
    assert isinstance(services.lsl.child.process, subprocess.Popen)
    assert not services.lsl.child.alive()


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (None, ""), ("", ""), ('{"message": "all went well"}\n', "all went well"),
        ("lsl: no room\n", "lsl: no room"),
        ('{"time": "2026-11-23T08:0', ""), ('{"level": "info"}\n', ""), ("{" * 100_000, ""),
        ("x" * 3 * LAST_BYTES + "\nlsl: gone\n", "lsl: gone"),
    ],
)  # fmt: skip
def test_whatever_its_log_is(tmp_path: Path, log: str | None, words: str) -> None:
    if log is not None:
        (tmp_path / "lsl.log").write_text(log)
    assert Child("lsl", [], tmp_path / "lsl.log").last_words() == words
