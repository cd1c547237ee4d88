"""A wire test that fails while the machine stands still is run once more, and told; nothing else is run twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.harness.standstill import LIMIT_S, Meter

ROOT = Path(__file__).parents[1]
CONFTEST = """
from tests.harness import standstill
from tests.harness.standstill import Plugin, pytest_terminal_summary

standstill.MOST = 5

class Stood:
    def longest_s(self, since_s):
        return {stood_s}

def pytest_configure(config):
    config.pluginmanager.register(Plugin(Stood()))
    config.addinivalue_line("markers", "wire: x")
"""
TESTS = """
import pathlib, time, pytest

def runs(name):
    file = pathlib.Path(__file__).with_name(name)
    file.write_text("x" + (file.read_text() if file.exists() else ""))
    return len(file.read_text())

@pytest.fixture
def fresh():
    return []

@pytest.mark.wire
def test_fails_once(fresh):
    fresh.append(1)
    assert runs("once") == 2 and fresh == [1]

@pytest.mark.wire
def test_fails_always():
    assert runs("always") == 0

def test_pure():
    assert runs("pure") == 2

@pytest.mark.wire
def test_passes():
    assert runs("passes") == 1

@pytest.fixture(scope="module")
def kept():
    return []

@pytest.mark.wire
def test_is_not_helped_by_what_the_first_run_left(kept):
    kept.append(1)
    assert len(kept) == 2

@pytest.fixture
def unsafe():
    yield
    assert runs("unsafe") == 2, "still stimulating"

@pytest.mark.wire
def test_leaves_something_wrong(unsafe):
    pass

@pytest.mark.wire
def test_is_skipped_then():
    if runs("skipped") == 2:
        pytest.skip("no")
    assert False

@pytest.mark.wire
@pytest.mark.timeout(2)
def test_hangs_then():
    if runs("hangs") == 2:
        time.sleep(1000)
    assert False

@pytest.mark.wire
def test_is_one_too_many():
    assert runs("many") == 2
"""


def played(folder: Path, stood_s: float) -> str:
    (folder / "conftest.py").write_text(CONFTEST.format(stood_s=stood_s))
    (folder / "test_it.py").write_text(TESTS)
    command = [sys.executable, "-m", "pytest", "-c", "/dev/null", "-p", "no:cacheprovider", str(folder)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120).stdout


@pytest.mark.slow
def test_only_a_wire_test_that_failed_in_a_standstill_is_run_again_and_told(tmp_path: Path):
    text = played(tmp_path, 0.5)
    assert "6 failed, 3 passed, 1 error" in text, text
    runs = {"once": 2, "always": 2, "pure": 1, "passes": 1, "unsafe": 1, "skipped": 2, "hangs": 2, "many": 1}
    assert {name: len((tmp_path / name).read_text()) for name in runs} == runs
    told = [line for line in text.splitlines() if line.startswith("AGAIN ")]
    assert len(told) == 1
    assert "test_fails_once: stood still for 0.50 s at most lately; load" in told[0]


@pytest.mark.slow
def test_on_a_machine_that_did_not_stand_still_nothing_is_run_again(tmp_path: Path):
    text = played(tmp_path, LIMIT_S)
    assert "7 failed, 2 passed, 1 error" in text, text
    assert "AGAIN" not in text


@pytest.mark.slow
def test_a_standstill_is_measured():
    meter = Meter()
    try:
        end_s, began_s = time.monotonic() + 30, time.monotonic()
        while meter.longest_s(began_s) < 0.2:
            assert time.monotonic() < end_s
            meter.process.send_signal(signal.SIGSTOP)
            time.sleep(0.3)
            meter.process.send_signal(signal.SIGCONT)
            time.sleep(0.1)
        assert meter.longest_s(time.monotonic() + 60) == 0
    finally:
        meter.close()
    assert meter.process.poll() is not None
