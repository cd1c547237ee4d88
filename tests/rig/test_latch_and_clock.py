"""What is remembered across a death, and clocks that cannot be set back."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from rig.clock import MonotonicClock, VirtualClock, utc_text
from rig.control.latch import Latch, lock_folder
from rig.errors import BusyError


def test_the_latch_is_remembered(tmp_path: Path):
    latch = Latch(tmp_path)
    assert latch.read() == (None, "")
    latch.write("running", "test 7")
    assert Latch(tmp_path).read() == ("running", "test 7")
    latch.write("latched", "electrode")
    assert Latch(tmp_path).read() == ("latched", "electrode")
    latch.clear()
    latch.clear()
    assert latch.read() == (None, "")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"state": "running"}', "\udcff"])
def test_a_latch_that_cannot_be_read_counts_as_a_test_that_ran(tmp_path: Path, content: str):
    (tmp_path / "latch.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert Latch(tmp_path).read()[0] == "running"


def test_one_rig_a_folder(tmp_path: Path):
    held = lock_folder(tmp_path)
    with pytest.raises(BusyError, match="another rig"):
        lock_folder(tmp_path)
    held.close()
    lock_folder(tmp_path).close()


def test_a_virtual_clock_runs_events_in_order():
    clock, seen = VirtualClock(start_s=10.0), []
    clock.call_at(12.0, lambda: seen.append(("b", clock.now_s())))
    clock.call_at(11.0, lambda: seen.append(("a", clock.now_s())))
    assert not clock.wait(13.0)
    assert seen == [("a", 11.0), ("b", 12.0)]
    assert clock.now_s() == 13.0
    event = threading.Event()
    clock.call_at(14.0, event.set)
    assert clock.wait(20.0, event)
    assert clock.now_s() == 14.0


def test_a_fast_clock_waits_less():
    clock = MonotonicClock(100.0)
    asked_s, start, told_s = time.monotonic(), clock.now_s(), time.monotonic()
    assert not clock.wait(start + 10.0)
    again_s, now_s, end_s = time.monotonic(), clock.now_s(), time.monotonic()
    assert 10.0 <= now_s - start < 900.0  # a tenth of a second; ten of them if it waited in the world's
    assert 100.0 * (again_s - told_s) <= now_s - start <= 100.0 * (end_s - asked_s)
    assert clock.wait(clock.now_s() + 1e6, _set())
    with pytest.raises(ValueError, match="clock speed"):
        MonotonicClock(0.0)
    with pytest.raises(ValueError, match="clock speed"):
        MonotonicClock(float("nan"))


def _set() -> threading.Event:
    event = threading.Event()
    event.set()
    return event


def test_utc_is_written_as_iso_8601():
    assert utc_text(1_700_000_000.1234) == "2023-11-14T22:13:20.123Z"
