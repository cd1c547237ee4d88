"""The gate: nothing passes when it is shut, nothing outside the limits, and the intent is written first."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig import journal, limits
from rig.clock import VirtualClock
from rig.gate import Gate
from rig.journal import Journal, Kind
from rig.messages import Profile
from rig.signals import Ack, Pulse, PulseStatus
from tests.rig.fakes import FakeStimulator


class Setup:
    def __init__(self, folder: Path, **profile: float) -> None:
        self.clock = VirtualClock()
        self.stimulator = FakeStimulator(self.clock)
        self.faults: list[str] = []
        self.gate = Gate(self.stimulator, self.clock, self.faults.append, self.faults.append)
        self.path = folder / "gate.journal"
        self.path.unlink(missing_ok=True)
        self.journal = Journal(self.path)
        self.gate.reset()
        self.gate.open(self.journal, limits.for_profile(limits.HARD_LIMITS, Profile(**profile)))

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


def test_too_close_and_too_late_pulses_are_not_sent(tmp_path: Path):
    setup = Setup(tmp_path)
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED
    setup.clock.advance(0.005)
    assert setup.fire(100) == PulseStatus.REFUSED
    setup.clock.advance(0.02)
    assert setup.fire(100, latest_s=setup.clock.now_s() - 0.001) == PulseStatus.DROPPED
    assert setup.fire(100, latest_s=math.nan) == PulseStatus.DROPPED
    assert len(setup.stimulator.sent) == 1
    assert setup.gate.dropped == 2


def test_charge_per_second_holds_whatever_the_plan(tmp_path: Path):
    setup = Setup(tmp_path, current_ma=100.0, max_pulse_width_us=400.0)
    for _ in range(200):
        setup.fire(400, 100.0)
        setup.clock.advance(0.016)
    times = [t for t, _ in setup.stimulator.sent]
    for time_s in times:
        assert sum(p.charge_uc for t, p in setup.stimulator.sent if time_s <= t < time_s + 1.0) <= 1600.0


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats(0, 0.1)), max_size=15))
def test_whatever_is_asked_nothing_outside_reaches_the_device(tmp_path: Path, asked: list[tuple[float, float, float]]):
    setup = Setup(tmp_path, max_pulse_width_us=250.0)
    for width_us, current_ma, pause_s in asked:
        setup.fire(width_us, current_ma)
        setup.clock.advance(pause_s)
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
    assert setup.gate.oldest_unacknowledged_s() == setup.clock.now_s()
    setup.stimulator.on_ack(Ack(63, setup.clock.now_s()))  # nobody's
    assert setup.gate.oldest_unacknowledged_s() is not None
    setup.stimulator.on_ack(Ack(1, setup.clock.now_s(), "electrode error"))
    assert setup.gate.oldest_unacknowledged_s() is None
    assert setup.faults == ["stimulator: electrode error at pulse 1"]


def test_a_pulse_that_the_device_did_not_take_is_recorded_and_no_fault(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    setup.stimulator.on_ack(Ack(1, setup.clock.now_s(), "busy", fatal=False))
    assert setup.faults == []
    assert setup.gate.oldest_unacknowledged_s() is None
    kind, payload = journal.read(setup.path).blocks[-1]
    assert kind == Kind.ACKED
    assert payload.endswith(b"busy")


def test_disconnecting_stops_first_and_never_raises(tmp_path: Path):
    setup = Setup(tmp_path)
    setup.stimulator.silent = True
    setup.gate.disconnect()
    assert setup.stimulator.stops == 1
    assert setup.fire(100) == PulseStatus.REFUSED
