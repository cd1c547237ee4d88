"""A test on the virtual clock: pulses on time, late ones dropped, every fault stops it, and stops are confirmed."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.rig import archive
from stimrig.rig.acquire.evidence import DECAY_S, NO_SIGNAL, SILENT_S, watch_decay
from stimrig.rig.acquire.health import DEFAULT_WATCH, SYNC_PERIOD_S
from stimrig.rig.acquire.stream import LOOK_AT
from stimrig.rig.adapters.files import Files
from stimrig.rig.control.sealing import warnings
from stimrig.rig.devices import find, library
from stimrig.rig.limits import Steps
from stimrig.rig.messages import SegmentPlan
from stimrig.rig.signals import Ack, Pulse, PulseStatus
from stimrig.rig.tasks import Task
from tests.rig.fakes import VirtualRig, hold, rest, slow_work, void
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.virtual_time import VirtualMachine
from tests.simulator.wires import SimulatedPort, Wires
from tests.simulator.world import World

pytestmark = pytest.mark.slow


def test_the_sealed_file_holds_what_was_played(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    result = rig.execute()
    assert (result.outcome, result.reason) == ("completed", "")
    assert result.evidence.confirmed
    assert rig.stimulator.stops == 1
    times = np.array([t for t, _ in rig.stimulator.sent])
    assert len(times) == np.count_nonzero(np.trunc(rig.test.pulse_width_us)) == len(rig.gate.lateness_s)
    assert max(rig.gate.lateness_s) < 1e-9
    assert np.allclose(np.diff(times), 0.025)
    assert result.summary["charge_uc"] == pytest.approx(np.trunc(rig.test.pulse_width_us).sum() * 20e-3)
    assert result.summary["lost_samples"] == 0
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
        assert "angle" not in file
        assert list(file["segments/name"].asstr()[:]) == ["rest", "ramp", "rest"]
        assert list(file["segments/start_s"][:]) == [0.0, 0.5, 2.5]
        assert list(file["segments/end_s"][:]) == [0.5, 2.5, 3.0]
        assert file["alignment"].attrs["method"] == "sync"


@pytest.mark.parametrize("withdrawn", [False, True])
def test_an_end_that_the_device_does_not_confirm_is_a_fault(tmp_path: Path, withdrawn: bool):
    rig = VirtualRig(tmp_path)
    if withdrawn:
        rig.at(1.0, lambda: rig.halt.set("withdrawn", "signed out"))

    async def says_nothing_of_it() -> None: ...

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
        module = find("stimulator", name)
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


@pytest.mark.parametrize("name", library("stimulator"))
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


@pytest.mark.parametrize("up_s", [2.0, 0.2])
def test_pulses_that_are_left_out_make_no_steeper_rise_than_the_plan(tmp_path: Path, up_s: float):
    """The width climbs back by at most the limit a pulse, so the test goes on and startles nobody."""
    rig = VirtualRig(tmp_path, [SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": up_s, "down_s": 1.0})])
    rig.at(0.01, lambda: rig.clock.advance(0.11))  # too short for a pause: the width climbs from where it was
    result = rig.execute()
    assert (result.outcome, result.summary["pauses"]) == ("completed", [])
    widths_us = [0, *(pulse.pulse_width_us for _, pulse in rig.stimulator.sent)]
    assert max(np.diff(widths_us)) <= 50
    columns = rig.recording().columns
    dropped = columns["pulses/status"] == PulseStatus.DROPPED
    assert np.sum(dropped) == result.summary["dropped_pulses"] > 3
    planned_us, sent_us = (columns[f"pulses/{name}_width_us"] for name in ("pulse", "sent_pulse"))
    assert np.all(np.isnan(sent_us[dropped]))
    told = {pulse.index: pulse.pulse_width_us for pulse in rig.gate.done if pulse.pulse_width_us}
    assert told == {int(i): sent_us[i] for i in np.flatnonzero(sent_us > 0)}, "as clients are told"
    climbed = np.flatnonzero(planned_us - sent_us > 1)
    assert len(climbed) == 0 if up_s == 2.0 else 0 < len(climbed) < 20
    assert [f"{len(climbed)} pulses were narrower" in line for line in warnings(rig.recording())] == [True] * (
        up_s == 0.2
    )


def test_pulses_too_short_to_be_sent_are_none_that_were_narrowed(tmp_path: Path):
    """Each ramp on a stimulator whose shortest pulse is 10 µs told of dropped pulses; there were none."""
    rig = VirtualRig(tmp_path, [SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 2.0, "down_s": 1.0})])
    rig.execute()
    recording = rig.recording()
    planned_us, sent_us = (recording.columns[f"pulses/{name}_width_us"] for name in ("pulse", "sent_pulse"))
    assert np.any((planned_us > 1) & (planned_us < 10))
    sent_us[planned_us < 10] = 0.0
    assert not [line for line in warnings(recording) if "narrower" in line]
    sent_us[np.argmax(planned_us)] -= 20.0
    assert [line.split(":")[1] for line in warnings(recording) if "narrower" in line] == [
        " 1 pulse was narrower than planned, since after a pulse that was dropped, or too short to be sent, the "
        "width climbs no faster than its limit"
    ]


def test_late_acknowledgements_are_told_with_every_pulse_that_was_dropped(tmp_path: Path):
    """Those that came due before an acknowledgement, and those that were late: as the summary counts them."""
    rig = VirtualRig(tmp_path, [hold(on_s=2.0)])
    for at_s, delay_s in ((0.99, 0.04), (1.02, 0.001)):
        rig.at(at_s, lambda delay_s=delay_s: setattr(rig.stimulator, "ack_delay_s", delay_s))
    rig.at(1.5, lambda: rig.clock.advance(0.06))
    dropped = rig.execute().summary["dropped_pulses"]
    (told,) = [line for line in warnings(rig.recording()) if "late" in line]
    assert dropped > 2 and told == (
        "stimulator: 1 acknowledgement came late, 40 ms after the pulse was sent; this pulse may have been felt that "
        f"late; {dropped} pulses of the test were dropped"
    )


def test_after_a_rest_the_width_climbs_from_nothing(tmp_path: Path):
    """Also where pulses came before it, and those right after it were left out."""
    ramp = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.5, "down_s": 0.5})
    rest = SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.0})
    rig = VirtualRig(tmp_path, [ramp, rest, ramp.model_copy(update={"name": "again"})])
    rig.at(2.0, lambda: rig.clock.advance(0.16))
    assert rig.execute().outcome == "completed"
    columns = rig.recording().columns
    planned_us, sent_us = (columns[f"pulses/{name}_width_us"] for name in ("pulse", "sent_pulse"))
    dropped = np.flatnonzero(columns["pulses/status"] == PulseStatus.DROPPED)
    assert planned_us[dropped[0]] > 0 and planned_us[dropped[0] - 2] == 0
    assert sent_us[dropped[-1] + 1] <= 50 + planned_us[dropped[0] - 1] < planned_us[dropped[-1] + 1]


@pytest.mark.parametrize("late_s", [0.01, 0.03, 0.05, 0.07, 0.09])
def test_a_pulse_that_is_too_short_for_the_device_was_not_felt(tmp_path: Path, late_s: float):
    """After it and some that were left out the width climbs from nothing."""
    rig = VirtualRig(tmp_path, [SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 0.5, "down_s": 1.0})])
    rig.stimulator.steps = Steps(shortest_us=20.0)
    rig.at(late_s, lambda: rig.clock.advance(0.16))
    assert rig.execute().outcome == "completed"
    assert max(np.diff([0, *(pulse.pulse_width_us for _, pulse in rig.stimulator.sent)])) <= 50


class Failing(Files):
    """A disk that is full or gone once it is told so."""

    fault = ""

    def free_bytes(self, folder: Path) -> int:
        if self.fault == "gone":
            raise OSError(5, "Input/output error")
        return 8 * 2**20 - 1 if self.fault == "full" else super().free_bytes(folder)


WATCH_S = 0.15
"""A watch of 100 ms, and two pulses."""
FAULTS: dict[str, tuple[Callable[[VirtualRig], object], str, float]] = {
    "silent cell": (lambda r: setattr(r.cell, "silent", True), "torque is stale", WATCH_S),
    "NaN": (lambda r: setattr(r.cell, "nan", True), "not a number", WATCH_S),
    "torque over its limit": (lambda r: setattr(r.cell, "add_nm", 35.0), "outside -30 … 30", WATCH_S),
    "torque under its limit": (lambda r: setattr(r.cell, "add_nm", -40.0), "outside -30 … 30", WATCH_S),
    "counter jump": (lambda r: setattr(r.cell, "skip", 5000), "jumped", WATCH_S),
    "no ack": (lambda r: setattr(r.stimulator, "ack_delay_s", None), "not acknowledged", WATCH_S),
    "late ack": (lambda r: setattr(r.stimulator, "ack_delay_s", 0.3), "not acknowledged", WATCH_S),
    "electrode": (lambda r: setattr(r.stimulator, "error", "electrode error"), "electrode error at pulse", WATCH_S),
    "line broken": (lambda r: setattr(r.stimulator, "send_error", "no bytes taken"), "no bytes taken", WATCH_S),
    "unplugged": (lambda r: r.stimulator.on_lost("unplugged"), "unplugged", WATCH_S),
    "journal": (lambda r: setattr(r.journal, "_failure", "disk full"), "disk full", WATCH_S),
    "disk slow": (lambda r: slow_work(r.machine, 10.0), "too slow", DEFAULT_WATCH.stale_disk_s + 0.03),
    "disk full": (lambda r: setattr(r.machine.disk, "fault", "full"), "MB free", SYNC_PERIOD_S + 0.03),
    "disk gone": (lambda r: setattr(r.machine.disk, "fault", "gone"), "too slow", DEFAULT_WATCH.stale_disk_s + 0.03),
    "sender": (lambda r: r.clock.advance(1.1), "blocked", 0.03),
}
"""What happens, what is told, and within how many seconds nothing is sent or fed to the device's watchdog any more."""


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_stops_the_test(tmp_path: Path, name: str):
    inject, words, within_s = FAULTS[name]
    rig = VirtualRig(tmp_path, [hold(on_s=5.0)])
    rig.machine.disk = Failing()
    rig.cell.noise_nm = 0.01
    at: list[float] = []
    rig.at(1.2, lambda: (at.append(rig.clock.now_s()), inject(rig)))
    result = rig.execute()
    assert result.outcome == "fault"
    assert words in result.reason
    assert rig.stimulator.stops >= 1
    assert rig.stimulator.fed_s[-1] - rig.stimulator.fed_s[0] > 0.9, "before the fault it was fed"
    assert max(rig.stimulator.sent[-1][0], rig.stimulator.fed_s[-1]) - at[0] < within_s
    assert rig.gate.fire(99, Pulse(100.0, 20.0), rig.clock.now_s(), math.inf) == PulseStatus.REFUSED
    recording = rig.recording()
    assert recording.attributes["outcome"] == "fault"
    assert len(recording.columns["pulses/status"]) < len(rig.test.pulse_width_us)


def test_lost_samples_are_found_and_marked(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    for at_s, lost in ((0.7, 3), (1.3, 40)):
        rig.at(at_s, lambda lost=lost: setattr(rig.cell, "skip", lost))
    result = rig.execute()
    assert (result.outcome, result.summary["lost_samples"]) == ("completed", 43)
    columns = rig.recording().columns
    steps = np.diff(columns["torque/counter"])
    assert columns["torque/gaps"][:, 0].tolist() == (np.flatnonzero(steps > 1) + 1).tolist()
    assert columns["torque/gaps"][:, 1].tolist() == [3, 40]
    assert np.allclose(np.diff(columns["torque/time_s"]), steps / 1600, rtol=0.01)


def test_through_a_rest_the_device_is_fed_at_every_pulses_time(tmp_path: Path):
    rig = VirtualRig(tmp_path, [rest(3.0)])
    assert rig.execute().outcome == "completed"
    assert rig.stimulator.sent == []
    assert len(rig.stimulator.fed_s) == 120
    rig.gate.feed()  # after the test nothing feeds any more
    assert len(rig.stimulator.fed_s) == 120


def test_a_stop_is_confirmed_by_the_torque_falling(tmp_path: Path):
    rig = VirtualRig(tmp_path, [hold(on_s=3.0)])
    rig.at(1.505, lambda: rig.halt.set("stopped", "enough"))
    result = rig.execute()
    assert (result.outcome, result.reason) == ("stopped", "enough")
    assert result.evidence.confirmed
    assert "torque fell from 6.00" in result.evidence.detail
    assert rig.stimulator.sent[-1][0] <= rig.halt.time_s
    assert rig.stimulator.stopped_s[0] - rig.halt.time_s < 0.001, "it does not wait until the next pulse is due"


@pytest.mark.parametrize(("said", "kept"), [("ou\0ch", "ou\N{REPLACEMENT CHARACTER}ch"), ("ou\ud800ch", "ou?ch")])
def test_a_reason_that_no_file_can_hold_leaves_no_test_unsealed(tmp_path: Path, said: str, kept: str):
    rig = VirtualRig(tmp_path)
    rig.at(1.0, lambda: rig.halt.set("stopped", said))
    rig.execute()
    sealed = rig.seal()
    with h5py.File(sealed.path) as file:
        assert file.attrs["reason"] == kept


def test_a_stop_among_the_first_pulses_says_no_more_than_the_torque_does(tmp_path: Path):
    rig = VirtualRig(tmp_path, [hold(on_s=3.0)])
    rig.at(0.003, lambda: rig.halt.set("stopped", "enough"))
    result = rig.execute()
    assert result.evidence.confirmed
    assert "too small to show a fall" in result.evidence.detail
    assert "fell" not in result.evidence.detail


def test_a_stop_without_effect_is_not_called_confirmed(tmp_path: Path):
    rig = VirtualRig(tmp_path, [hold(on_s=3.0)])
    rig.at(1.5, lambda: (setattr(rig.cell, "add_nm", 10.0), rig.halt.set("stopped", "enough")))
    assert not rig.execute().evidence.confirmed
    (tmp_path / "2").mkdir()
    rig = VirtualRig(tmp_path / "2", [hold(on_s=3.0)])
    rig.at(1.5, lambda: (setattr(rig.stimulator, "silent", True), rig.halt.set("stopped", "enough")))
    result = rig.execute()
    assert not result.evidence.confirmed
    assert "no answer" in result.evidence.detail
    assert result.summary["duration_s"] == pytest.approx(1.5, abs=0.02)


def test_no_torque_no_test(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.cell.silent = True
    result = rig.execute()
    assert result.outcome == "fault"
    assert result.reason == f"no torque has come from the load cell on can0 yet: {LOOK_AT}"
    assert rig.stimulator.sent == []
    recording = rig.recording()
    assert recording.names == []
    assert {path: len(column) for path, column in recording.columns.items()} == {p: 0 for p, _, _ in archive.COLUMNS}
    assert warnings(recording) == []


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
        self.torque_nm, self._settles_s, self._silent, self._each_s = torque_nm, settles_s, silent, each_s
        self.machine = VirtualMachine()
        self.began_s = self.machine.clock.now_s()

    def torque_around(self, _duration_s: float) -> float:
        return self.torque_nm

    def age_s(self, now_s: float) -> float:
        return math.inf if self._silent else (now_s - self.began_s) % self._each_s

    def settled(self) -> bool:
        return self.waited_s() >= self._settles_s

    def waited_s(self) -> float:
        return self.machine.clock.now_s() - self.began_s

    def confirms(self, at_stop_nm: float | None = 8.0) -> tuple[bool, str]:
        gate: Any = SimpleNamespace(last_pulse_s=self.began_s)
        receiver: Any = self
        return self.machine.run(watch_decay(gate, receiver, self.machine.tasks, 0.0, at_stop_nm))


@pytest.mark.parametrize(
    ("at_stop_nm", "now_nm", "confirmed"),
    [
        (8.0, 3.9, True), (-8.0, -3.9, True), (8.0, 4.1, False), (-8.0, -8.0, False), (6.0, -14.0, False),
        (None, 0.4, True), (None, -0.4, True), (None, 10.0, False), (None, -10.0, False),
    ],
)  # fmt: skip
def test_a_torque_far_from_its_rest_on_either_side_confirms_no_stop(
    at_stop_nm: float | None, now_nm: float, confirmed: bool
):
    assert Heard(now_nm).confirms(at_stop_nm)[0] is confirmed


@pytest.mark.parametrize(("silent", "longest_s"), [(False, DECAY_S), (True, SILENT_S)])
def test_what_a_buffer_gives_up_confirms_no_stop(silent: bool, longest_s: float):
    """Its oldest samples are of the rest before the first pulse; a cable that is out is not waited for as long."""
    endless = Heard(0.0, settles_s=math.inf, silent=silent)
    assert endless.confirms() == (False, NO_SIGNAL)
    assert endless.waited_s() == pytest.approx(longest_s, abs=0.05)


@pytest.mark.parametrize("each_s", [0.001, 0.2])
def test_a_stop_waits_while_a_backlog_is_read_also_where_samples_come_in_bursts(each_s: float):
    """A reader that a busy machine lets run each 0.2 s only is not a cable that is out."""
    late = Heard(0.0, settles_s=1.5, each_s=each_s)
    assert late.confirms()[0]
    assert late.waited_s() == pytest.approx(1.5, abs=0.1)


class HeardAfter(Heard):
    """Nothing came between 0.05 s and 0.9 s, and everything came afterwards."""

    def age_s(self, _now_s: float) -> float:
        return self.waited_s() - 0.05 if 0.05 <= self.waited_s() < 0.9 else 0.001


def test_a_stop_waits_for_the_torque_of_a_machine_that_stood_still():
    """Nobody looked while it stood still: that is no silence of the cell."""
    heard = HeardAfter(0.0, settles_s=0.9)
    clock = heard.machine.clock
    clock.call_at(heard.began_s + 0.05, lambda: clock.advance(0.8))
    assert heard.confirms()[0]
    assert heard.waited_s() == pytest.approx(0.9, abs=0.05)


def test_torque_that_falls_long_after_the_time_for_it_confirms_no_stop():
    """The looks come 60 ms late, the samples do not."""
    heard = Heard(20.0)
    heard.machine.clock.call_at(heard.began_s + 15.0, lambda: setattr(heard, "torque_nm", 0.0))
    tasks = heard.machine.tasks
    sleep = tasks.sleep
    tasks.sleep = lambda real_s: sleep(real_s + 0.06)
    confirmed, _ = heard.confirms(at_stop_nm=20.0)
    assert heard.waited_s() <= 2 * DECAY_S
    assert not confirmed


def test_a_reader_that_fell_behind_confirms_no_stop_by_torque_from_before_the_first_pulse(tmp_path: Path):
    """The run is stopped because samples arrive at half the rate; their torque is still that of the rest."""
    ramp = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 1.0, "down_s": 4.0})
    rig = VirtualRig(tmp_path, [rest(2.0), ramp])
    rig.at(0.0, lambda: setattr(rig.cell, "read_share", 0.5))
    result = rig.execute()
    assert result.outcome == "fault"
    assert "samples/s arrive" in result.reason
    assert not result.evidence.confirmed
