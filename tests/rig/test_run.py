"""A test on the virtual clock: pulses on time, late ones dropped, every fault stops it, all of it in the journal."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hardware_sim.factory import make_devices
from hardware_sim.settings import Settings
from rig import archive, assembly, journal
from rig.acquire.evidence import DECAY_S, SILENT_S, watch_decay
from rig.devices import p24, rehastim2
from rig.errors import RecordingError, WireError
from rig.journal import Kind
from rig.messages import SegmentPlan
from rig.signals import Ack, Pulse, PulseStatus
from rig.tasks import Task
from tests.rig.fakes import VirtualRig, void
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.wires import SimulatedPort, Wires
from tests.simulator.world import World


def test_a_test_plays_to_its_end(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    result = rig.execute()
    assert (result.outcome, result.reason) == ("completed", "")
    assert result.evidence.confirmed
    assert rig.stimulator.stops == 1
    times = np.array([t for t, _ in rig.stimulator.sent])
    assert len(times) == np.count_nonzero(np.trunc(rig.test.pulse_width_us)) == len(result.lateness_s)
    assert max(result.lateness_s) < 1e-9
    assert np.allclose(np.diff(times), 0.025)
    assert result.charge_uc == pytest.approx(np.trunc(rig.test.pulse_width_us).sum() * 20e-3)
    assert result.counts.lost_samples == 0


def test_the_sealed_file_holds_what_was_played(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.execute()
    sealed = rig.seal()
    with h5py.File(sealed.path) as file:
        assert file.attrs["outcome"] == "completed"
        assert file.attrs["content_sha256"] == sealed.content_sha256 == archive.verify(sealed.path)
        status = file["pulses/status"][:]
        assert np.array_equal(status == PulseStatus.REST, np.trunc(rig.test.pulse_width_us) == 0)
        assert np.all(status[status != PulseStatus.REST] == PulseStatus.ACKNOWLEDGED)
        written = file["pulses/written_time_s"][:]
        assert np.allclose(written[np.isfinite(written)], file["pulses/planned_time_s"][:][np.isfinite(written)])
        assert np.nanmedian(file["pulses/acknowledged_time_s"][:] - written) == pytest.approx(0.001)
        time_s = file["torque/time_s"][:]
        assert len(time_s) == pytest.approx(rig.test.duration_s * 1600, abs=12)
        assert time_s[0] < 0.01
        assert np.diff(time_s) == pytest.approx(1 / 1600)
        assert list(file["segments/name"].asstr()[:]) == ["rest", "ramp", "rest"]
        assert list(file["segments/start_s"][:]) == [0.0, 0.5, 2.5]
        assert list(file["segments/end_s"][:]) == [0.5, 2.5, 3.0]
        assert file["alignment"].attrs["method"] == "sync"


def test_an_end_that_the_device_does_not_confirm_is_a_fault(tmp_path: Path):
    rig = VirtualRig(tmp_path)

    async def says_nothing_of_it() -> None:
        rig.stimulator.stops += 1

    rig.stimulator.stop = says_nothing_of_it
    result = rig.execute()
    assert result.outcome == "fault"
    assert "the end of stimulation is not confirmed: armed" in result.reason
    assert not result.evidence.confirmed


class Line:
    """A driver, armed, on the simulator's line to the emulated stimulator."""

    def __init__(self, name: str) -> None:
        self.world = World(1)
        self.devices = make_devices(Settings(stimulator=name))
        computer = Computer(self.world, 0.0, 0.0)
        self.process = Process(computer, SimulatedDisk(self.world), Wires(self.world, self.devices, 0.02, void))
        module = {"p24": p24, "rehastim2": rehastim2}[name]
        self.driver = module.create(module.Settings(device=name, port="none"), self.process)
        self.told: list[Ack] = []
        self.driver.listen(self.told.append, void)
        self.ask(self.driver.open())
        self.ask(self.driver.arm())

    def ask(self, request: Coroutine[Any, Any, Any]) -> None:
        asked: list[Task[Any]] = []
        self.process.post(lambda: asked.append(self.process.tasks.spawn(request, "test")))
        self.world.run(self.world.now_s + 0.6)
        assert asked[0].result is None or asked[0].result


@pytest.mark.parametrize("name", ["p24", "rehastim2"])
def test_a_stop_takes_back_what_waits_in_the_computer_before_it_asks(name: str, monkeypatch: pytest.MonkeyPatch):
    line, did = Line(name), list[str]()
    write = SimulatedPort.write
    monkeypatch.setattr(SimulatedPort, "discard", lambda _: did.append("discard"))
    monkeypatch.setattr(SimulatedPort, "write", lambda port, data: (did.append("write"), write(port, data))[1])
    line.ask(line.driver.stop())
    assert did == ["discard", "write"]


def test_a_stimulator_that_restarts_in_a_test_is_told():
    line = Line("rehastim2")
    assert line.told == []
    line.devices.power_cycle()
    line.world.run(line.world.now_s + 0.7)  # it offers a connection every 0.5 s
    assert "it restarted during a test" in str(line.told[0].error)


@pytest.mark.parametrize(("up_s", "outcome"), [(2.0, "completed"), (0.2, "fault")])
def test_pulses_that_are_left_out_make_no_steeper_rise_than_the_plan(tmp_path: Path, up_s: float, outcome: str):
    """Of 4 µs a pulse some may be missing, of 37 µs not: the next one would be far above the last one that was felt."""
    rig = VirtualRig(tmp_path, [SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": up_s, "down_s": 1.0})])
    rig.at(0.01, lambda: rig.clock.advance(0.16))
    result = rig.execute()
    assert result.outcome == outcome
    assert ("left out while the width rose" in result.reason) is (outcome == "fault")
    widths_us = [0, *(pulse.pulse_width_us for _, pulse in rig.stimulator.sent)]
    assert max(np.diff(widths_us)) <= 50


def test_a_damaged_answer_of_the_stimulator_ends_a_test_like_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rig = VirtualRig(tmp_path)

    async def state() -> tuple[bool, str]:
        raise WireError("status: 1 byte")

    monkeypatch.setattr(rig.stimulator, "state", state)
    result = rig.execute()
    assert (result.outcome, result.evidence.confirmed) == ("fault", False)
    assert "status: 1 byte" in result.reason
    assert rig.recording().attributes["outcome"] == "fault"


def test_a_late_pulse_is_dropped_and_recorded_never_burst(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.at(1.2, lambda: rig.clock.advance(0.040))  # the process is not scheduled for 40 ms
    result = rig.execute()
    assert result.outcome == "completed"
    assert result.dropped in (1, 2)
    times = np.array([t for t, _ in rig.stimulator.sent])
    assert np.min(np.diff(times)) > 0.025 - 0.4 * 0.025 - 1e-9
    recording = rig.recording()
    status, sent = recording.columns["pulses/status"], recording.columns["pulses/sent_pulse_width_us"]
    assert np.sum(status == PulseStatus.DROPPED) == result.dropped
    assert np.all(np.isnan(sent[status == PulseStatus.DROPPED]))


def test_a_long_stall_sends_nothing_afterwards(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.at(1.0, lambda: rig.clock.advance(2.0))  # SIGSTOP
    result = rig.execute()
    assert result.outcome == "fault"
    assert "blocked for 2.0 s" in result.reason
    assert rig.clock.now_s() - rig.stimulator.sent[-1][0] > 2.0


FAULTS: dict[str, tuple[Callable[[VirtualRig], object], str]] = {
    "silent cell": (lambda r: setattr(r.cell, "silent", True), "torque is stale"),
    "NaN": (lambda r: setattr(r.cell, "nan", True), "not a number"),
    "torque over its limit": (lambda r: setattr(r.cell, "add_nm", 35.0), "outside -30 … 30"),
    "torque under its limit": (lambda r: setattr(r.cell, "add_nm", -35.0), "outside -30 … 30"),
    "counter jump": (lambda r: setattr(r.cell, "skip", 5000), "jumped"),
    "no ack": (lambda r: setattr(r.stimulator, "ack_delay_s", None), "not acknowledged"),
    "late ack": (lambda r: setattr(r.stimulator, "ack_delay_s", 0.3), "not acknowledged"),
    "electrode": (lambda r: setattr(r.stimulator, "error", "electrode error"), "electrode error at pulse"),
    "line broken": (lambda r: setattr(r.stimulator, "send_error", "no bytes taken"), "no bytes taken"),
    "unplugged": (lambda r: r.stimulator.on_lost("unplugged"), "unplugged"),
    "journal": (lambda r: setattr(r.journal, "_failure", "disk full"), "disk full"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_stops_the_test(tmp_path: Path, name: str):
    inject, words = FAULTS[name]
    rig = VirtualRig(tmp_path)
    at: list[float] = []
    rig.at(1.2, lambda: (at.append(rig.clock.now_s()), inject(rig)))
    result = rig.execute()
    assert result.outcome == "fault"
    assert words in result.reason
    assert rig.stimulator.stops >= 1
    assert rig.stimulator.sent[-1][0] - at[0] < 0.15  # watch period of 100 ms and two pulses
    assert rig.gate.fire(99, Pulse(100.0, 20.0), rig.clock.now_s(), math.inf) == PulseStatus.REFUSED
    recording = rig.recording()
    assert recording.attributes["outcome"] == "fault"
    assert len(recording.columns["pulses/status"]) < len(rig.test.pulse_width_us)


def test_a_stop_is_confirmed_by_the_torque_falling(tmp_path: Path):
    hold = [SegmentPlan(name="hold", sequence="steps", settings={"on_s": 3.0, "off_s": 0.0})]
    rig = VirtualRig(tmp_path, hold)
    rig.at(1.5, lambda: rig.halt.set("stopped", "enough"))
    result = rig.execute()
    assert (result.outcome, result.reason) == ("stopped", "enough")
    assert result.evidence.confirmed
    assert "torque fell from 6.00" in result.evidence.detail
    assert rig.stimulator.sent[-1][0] <= rig.halt.time_s


@pytest.mark.parametrize(("said", "kept"), [("ou\0ch", "ou\N{REPLACEMENT CHARACTER}ch"), ("ou\ud800ch", "ou?ch")])
def test_a_reason_that_no_file_can_hold_leaves_no_test_unsealed(tmp_path: Path, said: str, kept: str):
    rig = VirtualRig(tmp_path)
    rig.at(1.0, lambda: rig.halt.set("stopped", said))
    rig.execute()
    sealed = rig.seal()
    with h5py.File(sealed.path) as file:
        assert file.attrs["reason"] == kept


def test_a_stop_among_the_first_pulses_says_no_more_than_the_torque_does(tmp_path: Path):
    hold = [SegmentPlan(name="hold", sequence="steps", settings={"on_s": 3.0, "off_s": 0.0})]
    rig = VirtualRig(tmp_path, hold)
    rig.at(0.003, lambda: rig.halt.set("stopped", "enough"))
    result = rig.execute()
    assert result.evidence.confirmed
    assert "too small to show a fall" in result.evidence.detail
    assert "fell" not in result.evidence.detail


def test_a_stop_without_effect_is_not_called_confirmed(tmp_path: Path):
    hold = [SegmentPlan(name="hold", sequence="steps", settings={"on_s": 3.0, "off_s": 0.0})]
    rig = VirtualRig(tmp_path, hold)
    rig.at(1.5, lambda: (setattr(rig.cell, "add_nm", 10.0), rig.halt.set("stopped", "enough")))
    assert not rig.execute().evidence.confirmed
    (tmp_path / "2").mkdir()
    rig = VirtualRig(tmp_path / "2", hold)
    rig.at(1.5, lambda: (setattr(rig.stimulator, "silent", True), rig.halt.set("stopped", "enough")))
    result = rig.execute()
    assert not result.evidence.confirmed
    assert "no answer" in result.evidence.detail
    assert result.duration_s == pytest.approx(1.5, abs=0.02)


def test_no_torque_no_test(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.cell.silent = True
    result = rig.execute()
    assert result.outcome == "fault"
    assert "no torque arrived" in result.reason
    assert rig.stimulator.sent == []
    recording = rig.recording()
    assert recording.names == []
    assert {path: len(column) for path, column in recording.columns.items()} == {p: 0 for p, _, _ in archive.COLUMNS}


@pytest.mark.slow
def test_a_journal_cut_anywhere_seals_what_it_holds(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.execute()
    whole = rig.path.read_bytes()
    cut = tmp_path / "cut.journal"
    acknowledged = []
    for length in np.linspace(len(whole), 0, 60).astype(int):
        cut.write_bytes(whole[:length])
        try:
            contents = journal.read(cut)
            recording = assembly.assemble(contents, "fault", "killed")
        except RecordingError as error:
            assert length < 6000, error  # header and plan
            continue
        columns = recording.columns
        assert recording.attributes["outcome"] == ("completed" if contents.ended else "fault")
        told = sum(kind == Kind.ACKED for kind, _ in contents.blocks)
        intents = sum(kind == Kind.INTENT for kind, _ in contents.blocks)
        assert np.sum(columns["pulses/status"] == PulseStatus.ACKNOWLEDGED) == told
        assert np.sum(np.nan_to_num(columns["pulses/current_ma"]) > 0) == intents
        assert np.all(np.isfinite(columns["torque/time_s"]))
        assert len({len(c) for p, c in columns.items() if p.startswith("pulses/")}) == 1
        acknowledged.append(told)
        archive.to_bytes(recording)
    assert acknowledged[0] > 70
    assert acknowledged == sorted(acknowledged, reverse=True)


@pytest.mark.parametrize("n", [1, 2, 17, 60])
def test_halting_between_pulses_sends_none_after(tmp_path: Path, n: int):
    rig = VirtualRig(tmp_path)
    sent_at_halt: list[int] = []

    def halt_soon(count: int) -> None:
        if count == n:
            at = rig.clock.now_s() + 0.0249
            rig.clock.call_at(at, lambda: (sent_at_halt.append(len(rig.stimulator.sent)), rig.halt.set("stopped", "x")))

    rig.stimulator.on_send = halt_soon
    rig.execute()
    assert len(rig.stimulator.sent) == sent_at_halt[0] == n


@pytest.mark.parametrize(("held_s", "confirmed"), [(0.2, True), (0.6, False)])
def test_a_stop_waits_for_the_torque_of_a_host_that_paused(tmp_path: Path, held_s: float, confirmed: bool):
    hold = [SegmentPlan(name="hold", sequence="steps", settings={"on_s": 3.0, "off_s": 0.0})]
    rig = VirtualRig(tmp_path, hold)
    rig.at(1.5, lambda: rig.halt.set("stopped", "enough"))
    rig.cell.held = lambda now_s: 0.0 < now_s - rig.halt.time_s < held_s if rig.halt.cause else False
    result = rig.execute()
    assert result.evidence.confirmed is confirmed, result.evidence.detail


@pytest.mark.parametrize("moved_nm", [3.0, -8.0])
def test_a_rest_is_measured_again_at_the_first_pulse(tmp_path: Path, moved_nm: float):
    """The limb moved between arming and the first pulse: by what is not the muscle's."""
    (tmp_path / "still").mkdir()
    still_nm = VirtualRig(tmp_path / "still").execute().rise_nm
    rig = VirtualRig(tmp_path)
    rig.at(0.1, lambda: setattr(rig.cell, "add_nm", 0.5 * moved_nm))  # slowly enough to be no knock
    rig.at(0.2, lambda: setattr(rig.cell, "add_nm", moved_nm))
    result = rig.execute()
    assert result.outcome == "completed", result.reason
    assert still_nm is not None and 1.0 < still_nm < 8.0
    assert result.rise_nm == pytest.approx(still_nm, abs=0.01)


class Heard:
    """A receiver of which the torque is always the same, after a backlog of `settles_s`."""

    def __init__(self, torque_nm: float, settles_s: float = 0.0, silent: bool = False, each_s: float = 0.001) -> None:
        self._torque_nm, self._settles_s, self._silent, self._each_s = torque_nm, settles_s, silent, each_s
        self.asked_s: list[float] = []

    def torque_around(self, _duration_s: float) -> float:
        return self._torque_nm

    def age_s(self, now_s: float) -> float:
        self.asked_s.append(now_s)
        return float("inf") if self._silent else (now_s - self.asked_s[0]) % self._each_s

    def settled(self) -> bool:
        return self.waited_s() >= self._settles_s

    def waited_s(self) -> float:
        return self.asked_s[-1] - self.asked_s[0] if self.asked_s else 0.0


def watched(
    tmp_path: Path, heard: Heard, at_stop_nm: float | None, stood_still_s: float | None = None
) -> tuple[bool, str]:
    """A stop of a rig that has played; `stood_still_s`: until then the machine stands still, from 0.05 s on."""
    rig = VirtualRig(tmp_path)
    rig.execute()
    if stood_still_s is not None:
        rig.clock.call_at(rig.clock.now_s() + 0.05, lambda: rig.clock.advance(stood_still_s - 0.05))
    return rig.machine.run(watch_decay(rig.gate, heard, rig.machine.tasks, 0.0, at_stop_nm))  # pyright: ignore


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at_stop_nm", "now_nm", "confirmed"),
    [
        (8.0, 3.9, True), (-8.0, -3.9, True), (8.0, 4.1, False), (-8.0, -8.0, False), (6.0, -14.0, False),
        (None, 0.4, True), (None, -0.4, True), (None, 10.0, False), (None, -10.0, False),
    ],
)  # fmt: skip
def test_a_torque_far_from_its_rest_on_either_side_confirms_no_stop(
    tmp_path: Path, at_stop_nm: float | None, now_nm: float, confirmed: bool
):
    assert watched(tmp_path, Heard(now_nm), at_stop_nm)[0] is confirmed


def test_what_a_buffer_gives_up_confirms_no_stop(tmp_path: Path):
    """Its oldest samples are of the rest before the first pulse."""
    assert watched(tmp_path, Heard(0.0, settles_s=np.inf), 8.0) == (
        False,
        "there is no torque signal to confirm the stop",
    )


@pytest.mark.slow
def test_a_stop_waits_while_a_backlog_is_read_and_not_where_nothing_comes(tmp_path: Path):
    """What comes after a backlog is of now; a cable that is out gives no such hope."""
    late = Heard(0.0, settles_s=1.5)
    assert watched(tmp_path, late, 8.0)[0]
    assert late.waited_s() == pytest.approx(1.5, abs=0.1)
    for silent, longest_s in ((False, DECAY_S), (True, SILENT_S)):
        (folder := tmp_path / str(silent)).mkdir()
        endless = Heard(0.0, settles_s=np.inf, silent=silent)
        assert not watched(folder, endless, 8.0)[0]
        assert endless.waited_s() == pytest.approx(longest_s, abs=0.05)


@pytest.mark.slow
def test_a_stop_waits_where_samples_come_in_bursts(tmp_path: Path):
    """A reader that a busy machine lets run each 0.2 s only is not a cable that is out."""
    bursts = Heard(0.0, settles_s=1.5, each_s=0.2)
    assert watched(tmp_path, bursts, 8.0)[0]
    assert bursts.waited_s() == pytest.approx(1.5, abs=0.1)


class HeardAfter(Heard):
    """Nothing came between 0.05 s and 0.9 s, and everything came afterwards."""

    def age_s(self, now_s: float) -> float:
        super().age_s(now_s)
        return self.waited_s() - 0.05 if 0.05 <= self.waited_s() < 0.9 else 0.001


@pytest.mark.slow
def test_a_stop_waits_for_the_torque_of_a_machine_that_stood_still(tmp_path: Path):
    """Nobody looked while it stood still: that is no silence of the cell."""
    heard = HeardAfter(0.0, settles_s=0.9)
    assert watched(tmp_path, heard, 8.0, stood_still_s=0.85)[0]
    assert heard.waited_s() == pytest.approx(0.9, abs=0.05)
