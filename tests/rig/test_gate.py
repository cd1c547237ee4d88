"""The gate: nothing passes when it is shut, nothing outside the limits, and the intent is written first."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stimrig.rig import journal, limits
from stimrig.rig.errors import DeviceError
from stimrig.rig.gate import Gate
from stimrig.rig.journal import Kind
from stimrig.rig.messages import Profile
from stimrig.rig.signals import Ack, Pulse, PulseStatus
from tests.rig.fakes import FakeStimulator, journal_at
from tests.simulator.virtual_time import VirtualClock, VirtualMachine


class Setup:
    """An open gate, or one that is still shut."""

    def __init__(self, folder: Path, is_open: bool = True, start_s: float = 1000.0, **profile: float) -> None:
        self.machine = VirtualMachine(VirtualClock(start_s))
        self.clock, self.wait, self.halted = self.machine.clock, self.machine.wait, False
        self.stimulator = FakeStimulator(self.clock)
        self.faults: list[str] = []
        self.gate = Gate(self.stimulator, self.clock, self.faults.append, self.faults.append)
        self.path = folder / "gate.journal"
        self.path.unlink(missing_ok=True)
        self.journal = journal_at(self.path)
        self.gate.reset()
        self.table = limits.for_profile(limits.HARD_LIMITS, Profile(**profile))
        if is_open:
            self.open()

    def open(self) -> None:
        self.machine.run(self.gate.open(self.journal, self.table, lambda: self.halted))

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(payload) for kind, payload in journal.read(self.path).blocks if kind == Kind.EVENT]

    def fire(self, width_us: float, current_ma: float = 20.0, latest_s: float = math.inf) -> PulseStatus:
        return self.gate.fire(0, Pulse(width_us, current_ma), self.clock.now_s(), latest_s)


def test_shut_means_shut(tmp_path: Path):
    setup = Setup(tmp_path)
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED
    setup.gate.shut()
    assert setup.fire(100) == PulseStatus.REFUSED
    assert len(setup.stimulator.sent) == 1
    assert not setup.gate.is_open


def test_the_intent_is_written_before_the_command(tmp_path: Path):
    setup = Setup(tmp_path)
    on_disk: list[list[Kind]] = []
    setup.stimulator.on_send = lambda _: on_disk.append([kind for kind, _ in journal.read(setup.path).blocks])
    setup.fire(100)
    assert on_disk == [[Kind.EVENT, Kind.INTENT]]


def test_an_intent_that_cannot_be_written_sends_nothing(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.journal._failure = "disk full"
    with pytest.raises(Exception, match="disk full"):
        setup.fire(100)
    assert setup.stimulator.sent == []


def test_one_pulse_at_most_is_on_its_way(tmp_path: Path):
    """A line that holds what it is given may hold one pulse, and lets go a burst of one."""
    setup = Setup(tmp_path)
    setup.stimulator.ack_delay_s = 0.090
    statuses = []
    for _ in range(5):
        statuses.append(setup.fire(100))
        setup.wait(0.025)
    unacknowledged, dropped = PulseStatus.UNACKNOWLEDGED, PulseStatus.DROPPED
    assert statuses == [unacknowledged, dropped, dropped, dropped, unacknowledged]
    kinds = [kind for kind, _ in journal.read(setup.path).blocks]
    assert kinds.count(Kind.SKIPPED) == 3
    events = setup.events()
    assert [event["reason"] for event in events if event["event"] == "dropped"] == [
        "pulse 1 is not acknowledged yet"
    ] * 3
    late = [event["delay_s"] for event in events if event["event"] == "late_ack"]
    assert late == [pytest.approx(0.090)]


@pytest.mark.parametrize("ack_delay_s", [0.001, 0.012, 0.0169, 0.0171, 0.024])
def test_the_interval_counts_from_the_ack_since_the_pulse_may_have_been_felt_as_late(
    tmp_path: Path, ack_delay_s: float
):
    setup = Setup(tmp_path)
    setup.stimulator.ack_delay_s = ack_delay_s
    for _ in range(20):
        setup.fire(100)
        setup.wait(0.025)
    sent_s = [time_s for time_s, _ in setup.stimulator.sent]
    assert len(sent_s) == (20 if ack_delay_s < 0.017 else 10)
    # each may have been felt anywhere between its write and its ack
    assert all(
        later - acked >= 0.008 - 1e-9 for acked, later in zip(setup.stimulator.acked_s, sent_s[1:], strict=False)
    )


def test_a_stop_settles_what_was_on_its_way_and_says_so_until_then(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    setup.wait(0.08)
    assert setup.gate.still_possible() == "pulse 1 was sent 80 ms ago and not acknowledged: it may still be felt"
    setup.stimulator.silent = True
    with pytest.raises(DeviceError):
        setup.machine.run(setup.gate.stop())
    assert setup.gate.still_possible()
    setup.wait(0.5)
    setup.stimulator.silent = False
    setup.machine.run(setup.gate.stop())  # the line keeps its order: an answer to the stop came after the pulse
    assert setup.gate.still_possible() == ""
    assert setup.gate.last_pulse_s == setup.clock.now_s()


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats(0, 0.1)), max_size=15))
def test_whatever_is_asked_nothing_outside_reaches_the_device(tmp_path: Path, asked: list[tuple[float, float, float]]):
    setup = Setup(tmp_path, max_pulse_width_us=250.0)
    for width_us, current_ma, pause_s in asked:
        setup.fire(width_us, current_ma)
        setup.wait(pause_s)
    setup.wait(1.1)
    assert setup.fire(250.0) == PulseStatus.UNACKNOWLEDGED, "what is allowed still goes through"
    for _, pulse in setup.stimulator.sent:
        assert 0 < pulse.pulse_width_us <= 250
        assert 0 < pulse.current_ma <= 20
    times = [t for t, _ in setup.stimulator.sent]
    assert all(b - a >= 0.008 for a, b in itertools.pairwise(times))
    setup.journal.close()


def test_acks_and_errors_are_matched_by_number(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    assert setup.gate.on_its_way is not None
    setup.stimulator.on_ack(Ack(63, setup.clock.now_s(), "unknown command"))  # another's
    assert setup.gate.on_its_way is not None
    setup.stimulator.on_ack(Ack(1, setup.clock.now_s(), "electrode error"))
    assert setup.gate.on_its_way is None
    assert setup.faults == ["stimulator: unknown command", "stimulator: electrode error at pulse 1"]


def test_disconnecting_stops_first_and_never_raises(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.stimulator.silent = True
    setup.machine.run(setup.gate.disconnect())
    assert setup.stimulator.stops == 1
    assert setup.fire(100) == PulseStatus.REFUSED
