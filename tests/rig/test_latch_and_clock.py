"""What is remembered across a death, and clocks that cannot be set back."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from stimrig.rig.adapters.files import Files
from stimrig.rig.clock import MonotonicClock, utc_text
from stimrig.rig.control.memory import Latch
from stimrig.rig.errors import BusyError
from tests.rig.fakes import slow_work
from tests.simulator.virtual_time import VirtualMachine


def test_the_latch_is_remembered(tmp_path: Path):
    machine = VirtualMachine()
    latch = Latch(tmp_path, machine)
    assert machine.run(latch.read()) == (None, "")
    machine.run(latch.write("running", "test 7"))
    assert machine.run(Latch(tmp_path, machine).read()) == ("running", "test 7")
    machine.run(latch.write("latched", "electrode"))
    assert machine.run(Latch(tmp_path, machine).read()) == ("latched", "electrode")
    machine.run(latch.clear())
    machine.run(latch.clear())
    assert machine.run(latch.read()) == (None, "")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"state": "running"}', "\udcff"])
def test_a_latch_that_cannot_be_read_counts_as_a_test_that_ran(tmp_path: Path, content: str):
    (tmp_path / "latch.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    machine = VirtualMachine()
    assert machine.run(Latch(tmp_path, machine).read())[0] == "running"


def test_what_is_asked_for_first_is_written_first_however_slow_the_disk_is(tmp_path: Path):
    machine = VirtualMachine()
    slow_work(machine, 0.5, 0.1, 0.3)
    latch = Latch(tmp_path, machine)
    asked = latch.write("running", "test 7"), latch.clear(), latch.write("latched", "electrode")
    tasks = [machine.tasks.begin(one, str(number)) for number, one in enumerate(asked)]
    machine.run(machine.tasks.join(tasks[-1]))
    assert machine.clock.now_s() == pytest.approx(1000.9)
    assert '"electrode"' in (tmp_path / "latch.json").read_text()


def test_one_rig_a_folder(tmp_path: Path):
    held = Files().lock(tmp_path)
    with pytest.raises(BusyError, match="another rig"):
        Files().lock(tmp_path)
    held.close()
    Files().lock(tmp_path).close()


def test_a_fast_clock_runs_faster():
    clock = MonotonicClock(100.0)
    asked_s, start_s, told_s = MonotonicClock().now_s(), clock.now_s(), MonotonicClock().now_s()
    assert 100.0 * asked_s <= start_s <= 100.0 * told_s
    for speed in (0.0, float("nan")):
        with pytest.raises(ValueError, match="clock speed"):
            MonotonicClock(speed)


def test_the_clock_goes_on_while_the_machine_is_suspended(monkeypatch: pytest.MonkeyPatch):
    before_s, gettime = MonotonicClock().now_s(), time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda clock: gettime(clock) + 3600 * (clock == time.CLOCK_BOOTTIME))
    assert MonotonicClock().now_s() >= before_s + 3600


def test_utc_is_written_as_iso_8601():
    assert utc_text(1_700_000_000.1234) == "2023-11-14T22:13:20.123Z"
