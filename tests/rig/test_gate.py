"""The gate: nothing passes when it is shut, nothing outside the limits, the intent is written first; its counts."""

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
from stimrig.rig import journal as jn
from stimrig.rig.errors import DeviceError, JournalError
from stimrig.rig.gate import Done, Gate
from stimrig.rig.journal import Kind
from stimrig.rig.messages import Profile
from stimrig.rig.signals import Ack, Pulse, PulseStatus
from tests.rig.fakes import FakeStimulator, journal_at
from tests.simulator.virtual_time import VirtualClock, VirtualMachine


class Setup:
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


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    """An open gate."""
    return Setup(tmp_path)


def test_shut_means_shut(setup: Setup):
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED
    setup.gate.shut()
    assert setup.fire(100) == PulseStatus.REFUSED
    assert len(setup.stimulator.sent) == 1
    assert not setup.gate.is_open


def test_the_intent_is_written_before_the_command(setup: Setup):
    on_disk: list[list[Kind]] = []
    setup.stimulator.on_send = lambda _: on_disk.append([kind for kind, _ in journal.read(setup.path).blocks])
    setup.fire(100)
    assert on_disk == [[Kind.EVENT, Kind.INTENT]]


def test_an_intent_that_cannot_be_written_sends_nothing(setup: Setup):
    setup.journal._failure = "disk full"
    with pytest.raises(Exception, match="disk full"):
        setup.fire(100)
    assert setup.stimulator.sent == []


def test_one_pulse_at_most_is_on_its_way(setup: Setup):
    """A line that holds what it is given may hold one pulse, and lets go a burst of one."""
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
def test_the_interval_counts_from_the_ack_since_the_pulse_may_have_been_felt_as_late(setup: Setup, ack_delay_s: float):
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


def test_a_stop_settles_what_was_on_its_way_and_says_so_until_then(setup: Setup):
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


def test_acks_and_errors_are_matched_by_number(setup: Setup):
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    assert setup.gate.on_its_way is not None
    setup.stimulator.on_ack(Ack(63, setup.clock.now_s(), "unknown command"))  # another's
    assert setup.gate.on_its_way is not None
    setup.stimulator.on_ack(Ack(1, setup.clock.now_s(), "electrode error"))
    assert setup.gate.on_its_way is None
    assert setup.faults == ["stimulator: unknown command", "stimulator: electrode error at pulse 1"]
    assert blocks(setup, Kind.ACKED)[-1] == jn.ACKED.pack(0, T0_S) + b"electrode error"
    assert len(setup.events()) == 1, "neither late nor unasked for"


def test_disconnecting_stops_first_and_never_raises(setup: Setup):
    setup.stimulator.silent = True
    setup.machine.run(setup.gate.disconnect())
    assert setup.stimulator.stops == 1
    assert setup.fire(100) == PulseStatus.REFUSED


T0_S = 1000.0
"""Where the virtual clock begins."""


def blocks(setup: Setup, kind: Kind) -> list[bytes]:
    return [payload for found, payload in jn.read(setup.path).blocks if found == kind]


def test_a_new_gate_is_shut_and_empty(tmp_path: Path):
    setup = Setup(tmp_path, is_open=False)
    gate = setup.gate
    assert gate.is_open is False
    assert (gate.on_its_way, gate.last_pulse_s) == (None, None)
    assert (gate.lateness_s, gate.ack_delay_s, gate.charge_uc, gate.dropped) == ([], [], 0.0, 0)
    assert gate.still_possible() == ""
    assert setup.fire(100) == PulseStatus.REFUSED
    setup.stimulator.on_ack(Ack(1, T0_S))  # of whoever used the device before
    setup.stimulator.on_lost("unplugged")
    assert setup.faults == ["unplugged"]


def test_a_reset_forgets_the_test_before(setup: Setup):
    setup.fire(100)
    setup.wait(0.001)
    setup.fire(100)
    assert (setup.gate.charge_uc, setup.gate.dropped, len(setup.gate.done)) == (2.0, 1, 2)
    assert setup.gate.last_pulse_s == pytest.approx(T0_S + 0.001)
    setup.gate.reset()
    gate = setup.gate
    assert (gate.last_pulse_s, gate.lateness_s, gate.ack_delay_s) == (None, [], [])
    assert (gate.charge_uc, gate.dropped, gate.done) == (0.0, 0, [])
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED, "the interval of the test before counts no more"


def test_each_test_has_limits_of_its_own(setup: Setup):
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED
    narrow = limits.tightened(limits.HARD_LIMITS, "pulse_width_us", 99.0, "rig file")
    setup.machine.run(setup.gate.open(setup.journal, narrow, lambda: False))
    setup.wait(0.025)
    assert (setup.fire(100), setup.fire(99)) == (PulseStatus.REFUSED, PulseStatus.UNACKNOWLEDGED)


def test_lateness_charge_and_delay_are_those_of_the_pulses_sent(setup: Setup):
    setup.stimulator.ack_delay_s = 0.004
    now_s = setup.clock.now_s()
    setup.gate.fire(3, Pulse(100.7, 20.0), now_s - 0.002, now_s)
    pulse = setup.gate.on_its_way
    assert pulse is not None
    assert (pulse.index, pulse.number, pulse.written_s) == (3, 1, now_s)
    assert setup.gate.last_pulse_s == now_s
    setup.wait(0.01)
    assert setup.gate.lateness_s == [pytest.approx(0.002)]
    assert setup.gate.ack_delay_s == [pytest.approx(0.004)]
    assert setup.gate.last_pulse_s == pytest.approx(now_s + 0.004), "it may have been felt as late as its ack"
    assert setup.gate.charge_uc == pytest.approx(2.0), "what was sent, after rounding"
    assert [jn.INTENT.unpack(p) for p in blocks(setup, Kind.INTENT)] == [(3, now_s, now_s - 0.002, 100.0, 20.0)]
    assert [jn.WRITTEN.unpack(p) for p in blocks(setup, Kind.WRITTEN)] == [(3, 1, now_s)]
    assert [jn.ACKED.unpack(p) for p in blocks(setup, Kind.ACKED)] == [(3, pytest.approx(now_s + 0.004))]


def test_who_follows_a_test_learns_what_became_of_each_pulse(setup: Setup):
    """As it was sent and acknowledged; one that is on its way is not told yet."""
    written = []
    for index, width_us in ((3, 100.7), (4, 120.0)):
        written.append(setup.clock.now_s())
        setup.gate.fire(index, Pulse(width_us, 20.0), written[-1] - 0.002, written[-1])
        assert len(setup.gate.done) == index - 3
        setup.wait(0.025)
    acked = pytest.approx(setup.stimulator.acked_s[0])
    assert setup.gate.done[0] == Done(3, 100, written[0], acked, PulseStatus.ACKNOWLEDGED)
    assert setup.gate.done[1].pulse_width_us == 120
    setup.gate.fire(5, Pulse(0.4, 20.0), setup.clock.now_s(), setup.clock.now_s())
    assert setup.gate.done[2].status == PulseStatus.REST, "too short for the device: nothing was felt, and it is known"


@pytest.mark.parametrize(
    ("width_us", "current_ma", "status"),
    [
        (0.0, 20.0, PulseStatus.REST),
        (0.9, 20.0, PulseStatus.REST),
        (100.0, 0.4, PulseStatus.REST),
        (1.0, 0.5, PulseStatus.UNACKNOWLEDGED),
        (301.0, 20.0, PulseStatus.REFUSED),
    ],
)
def test_what_comes_to_no_pulse_is_a_rest(setup: Setup, width_us: float, current_ma: float, status: PulseStatus):
    assert setup.fire(width_us, current_ma) == status
    assert len(setup.stimulator.sent) == (status == PulseStatus.UNACKNOWLEDGED)
    skipped = status != PulseStatus.UNACKNOWLEDGED and width_us > 0  # of a planned rest nothing is written
    assert len(blocks(setup, Kind.SKIPPED)) == skipped
    assert setup.gate.dropped == 0


def test_no_second_holds_more_pulses_than_the_highest_rate(setup: Setup):
    """Small pulses, so that neither their charge nor their interval forbids them: the rate alone does."""
    statuses = []
    for _ in range(250):
        statuses.append(setup.fire(10, 1.0))
        setup.wait(0.010)
    times = [time_s for time_s, _ in setup.stimulator.sent]
    assert PulseStatus.REFUSED in statuses
    assert all(sum(start <= t < start + 1.0 for t in times) <= 61 for start in times)
    assert times[-1] - times[0] > 2.0, "after a second it goes on"
    refused = [event["reason"] for event in setup.events() if event["event"] == "refused"]
    assert refused[0].startswith("pulse_rate_hz 61 Hz is outside 1 … 60")


def test_the_charge_of_the_last_second_counts_from_the_ack_and_no_longer_than_a_second(tmp_path: Path):
    setup = Setup(tmp_path, current_ma=100.0, max_pulse_width_us=400.0)
    for _ in range(40):
        assert setup.fire(400, 100.0) == PulseStatus.UNACKNOWLEDGED
        setup.wait(0.020)
    assert setup.fire(400, 100.0) == PulseStatus.REFUSED
    setup.wait(0.2 + 0.0005)  # one second after the first write, not yet after its ack
    assert setup.fire(400, 100.0) == PulseStatus.REFUSED
    setup.wait(0.001)
    assert setup.fire(400, 100.0) == PulseStatus.UNACKNOWLEDGED
    assert setup.gate.charge_uc == pytest.approx(41 * 40.0)


def test_no_test_gets_more_charge_than_a_test_may(tmp_path: Path):
    setup = Setup(tmp_path, is_open=False)
    setup.table = limits.tightened(setup.table, "charge_per_test_uc", 20.0, "rig file")
    setup.open()
    statuses = []
    for _ in range(4):
        statuses.append(setup.fire(300, 20.0))
        setup.wait(2.0)
    assert statuses == [*[PulseStatus.UNACKNOWLEDGED] * 3, PulseStatus.REFUSED]
    assert setup.gate.charge_uc == pytest.approx(18.0)
    assert setup.events()[-1]["reason"].startswith("charge_per_test_uc 24 µC is outside 0 … 20 (rig file")


def test_the_journal_says_of_each_pulse_that_was_not_sent_why(setup: Setup):
    setup.gate.fire(0, Pulse(100, 20), T0_S, T0_S)
    setup.wait(0.005)
    now_s = setup.clock.now_s()
    setup.gate.fire(1, Pulse(100, 20), now_s, now_s)
    setup.gate.fire(2, Pulse(400, 20), now_s, now_s)
    for index, latest_s in ((3, now_s - 1), (4, math.nan)):
        assert setup.gate.fire(index, Pulse(100, 20), now_s, latest_s) == PulseStatus.DROPPED
    assert (len(setup.stimulator.sent), setup.gate.dropped) == (1, 3)
    arm, too_close, refused = setup.events()
    assert arm == {"event": "arm", "time_s": T0_S}
    row = limits.for_profile(limits.HARD_LIMITS, Profile())
    assert too_close == {
        "event": "dropped",
        "index": 1,
        "reason": str(limits.check(row["pulse_interval_s"], now_s - setup.stimulator.acked_s[0])),
        "time_s": now_s,
    }
    assert refused == {
        "event": "refused",
        "index": 2,
        "reason": str(limits.check(row["pulse_width_us"], 400)),
        "time_s": now_s,
    }
    assert [jn.SKIPPED.unpack(p) for p in blocks(setup, Kind.SKIPPED)] == [
        (1, PulseStatus.DROPPED, now_s),
        (2, PulseStatus.REFUSED, now_s),
        (3, PulseStatus.DROPPED, now_s),
        (4, PulseStatus.DROPPED, now_s),
    ]
    told = [(pulse.index, pulse.pulse_width_us) for pulse in setup.gate.done if pulse.index]
    assert told == [(1, 0), (2, 0), (3, 0), (4, 0)], "who follows the test knows them by their index"


@pytest.mark.parametrize("number", [0, 5])
def test_an_ack_that_nobody_asked_for_is_written_and_told(setup: Setup, number: int):
    setup.stimulator.on_ack(Ack(number, 1000.5))
    assert setup.faults == ["stimulator: it acknowledged a pulse that it was not sent; is the line disturbed?"]
    assert setup.events()[1:] == [{"event": "unasked_ack", "time_s": 1000.5}]
    assert [jn.ACKED.unpack(p) for p in blocks(setup, Kind.ACKED)] == [(-1, 1000.5)]
    setup.gate.shut()
    setup.stimulator.on_ack(Ack(number, 1000.6))  # after the end it is the answer to whatever was sent before
    assert len(setup.faults) == 1


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_late_acks_are_noted_by_real_time(setup: Setup, speed: float):
    setup.clock.speed = speed
    for number, real_s in ((1, 0.014), (2, 0.016)):
        setup.stimulator.ack_delay_s = None
        setup.fire(100)
        setup.wait(real_s * speed)
        assert setup.gate.still_possible() == (
            f"pulse 1 was sent {1e3 * real_s:.0f} ms ago and not acknowledged: it may still be felt"
        )
        setup.stimulator.on_ack(Ack(number, setup.clock.now_s()))
        assert setup.gate.still_possible() == ""
        setup.wait(1.0)
    late = [event for event in setup.events() if event["event"] == "late_ack"]
    assert late == [
        {"event": "late_ack", "index": 0, "delay_s": pytest.approx(0.016 * speed), "time_s": setup.gate.last_pulse_s}
    ]


def test_an_ack_after_exactly_the_time_allowed_is_not_late(tmp_path: Path):
    setup = Setup(tmp_path, start_s=0.0)  # at zero 0.015 s is exactly 15 ms
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    setup.stimulator.on_ack(Ack(1, 0.015))
    assert len(setup.events()) == 1, "arm alone"


def test_a_pulse_that_becomes_late_while_its_intent_is_written_is_dropped(setup: Setup):
    append = setup.journal.append

    def slow(kind: Kind, payload: bytes) -> None:
        append(kind, payload)
        setup.clock.advance(0.5)

    setup.journal.append = slow
    assert setup.gate.fire(7, Pulse(100, 20), T0_S, T0_S + 0.01) == PulseStatus.DROPPED
    assert setup.stimulator.sent == []
    assert (setup.gate.dropped, setup.gate.charge_uc, setup.gate.on_its_way) == (1, 0.0, None)
    assert [jn.SKIPPED.unpack(p) for p in blocks(setup, Kind.SKIPPED)] == [(7, PulseStatus.DROPPED, T0_S + 0.5)]


def test_pulses_are_rounded_to_the_steps_of_the_device_behind_the_gate(setup: Setup):
    setup.stimulator.steps = limits.Steps(pulse_width_us=4.0, current_ma=2.0, shortest_us=20.0)
    assert setup.fire(19.0) == PulseStatus.REST
    assert setup.fire(103.0, 19.9) == PulseStatus.UNACKNOWLEDGED
    assert [pulse for _, pulse in setup.stimulator.sent] == [limits.Admitted(100, 18.0)]


def test_a_pulse_exactly_a_second_old_no_longer_counts(tmp_path: Path):
    setup = Setup(tmp_path, current_ma=100.0, max_pulse_width_us=400.0)
    setup.stimulator.ack_delay_s = 0.0
    for _ in range(40):
        assert setup.fire(400, 100.0) == PulseStatus.UNACKNOWLEDGED
        setup.wait(1 / 64)
    setup.wait(T0_S + 1.0 - setup.clock.now_s())
    assert setup.fire(400, 100.0) == PulseStatus.UNACKNOWLEDGED
    setup.wait(1 / 128)
    assert setup.fire(400, 100.0) != PulseStatus.UNACKNOWLEDGED


def test_after_its_release_a_journal_gets_nothing_more(setup: Setup):
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    before = setup.path.read_bytes()
    setup.gate.release()
    assert setup.gate.is_open is False
    setup.stimulator.on_ack(Ack(1, setup.clock.now_s()))
    assert setup.fire(100) == PulseStatus.REFUSED
    assert setup.path.read_bytes() == before
    assert setup.gate.on_its_way is None, "the ack still settles what was on its way"


def test_an_ack_that_cannot_be_written_is_a_fault(setup: Setup):
    setup.fire(100)
    setup.journal._failure = "disk full"
    setup.wait(0.01)
    assert setup.faults == ["disk full"]


def test_a_watchdog_is_fed_while_the_gate_is_open_alone(setup: Setup):
    setup.gate.feed()
    setup.gate.shut()
    setup.gate.feed()
    assert setup.stimulator.fed_s == [T0_S]


def test_a_new_test_does_not_wait_for_an_ack_of_the_one_before(setup: Setup):
    """Arming is answered in order: what was on its way before has gone through, or is lost."""
    setup.stimulator.ack_delay_s = None
    setup.fire(100)
    setup.gate.release()
    setup.wait(1.0)
    setup.open()
    assert setup.gate.on_its_way is None
    assert setup.fire(100) == PulseStatus.UNACKNOWLEDGED


def test_a_gate_whose_device_or_journal_fails_stays_shut(tmp_path: Path):
    setup = Setup(tmp_path, is_open=False)
    gate, ask = setup.gate, setup.machine.run
    setup.stimulator.silent = True
    with pytest.raises(DeviceError):
        setup.open()
    assert not gate.is_open
    setup.stimulator.silent = False
    assert ask(gate.identify()) == {"device": "fake"}
    assert ask(gate.state()) == (True, "not initialised")
    setup.open()
    assert gate.is_open
    assert ask(gate.state()) == (False, "armed")
    gate.release()
    setup.journal._failure = "disk full"
    with pytest.raises(JournalError, match="disk full"):
        setup.open()
    assert not gate.is_open


@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.199, None])
def test_a_stop_during_arming_leaves_the_gate_shut(tmp_path: Path, after_s: float | None):
    """The device takes 0.2 s to arm: whenever the stop comes, no pulse follows."""
    setup = Setup(tmp_path, is_open=False)

    async def slowly() -> None:
        await setup.machine.tasks.sleep(0.2)
        setup.stimulator.armed = True

    setup.stimulator.arm = slowly
    if after_s is not None:
        setup.clock.call_at(T0_S + after_s, lambda: setattr(setup, "halted", True))
    setup.open()
    assert setup.clock.now_s() == T0_S + 0.2
    assert setup.gate.is_open is (after_s is None)
    assert setup.fire(100) == (PulseStatus.UNACKNOWLEDGED if after_s is None else PulseStatus.REFUSED)
