"""`stimrig rig check` in simulated time: planted wiring faults are named, a sound rig passes, and one pulse flows only
where a person says that a dummy load is connected."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.cli import main as stimrig
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.settings import Settings
from stimrig.rig import check as verb
from stimrig.rig import config
from stimrig.rig.check import CURRENT_MA, FAULTS, WIDTH_US, RigCheck, Step
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import ConfigError
from tests.api.test_schemas import unmet
from tests.simulator.disk import SimulatedDisk
from tests.simulator.host import Computer, Process
from tests.simulator.virtual_time import VirtualMachine
from tests.simulator.wires import Wires
from tests.simulator.world import World

FOLDER = Path("/rig")
LONGEST_S = 60.0


class Checked:
    """One check of an emulated rig in simulated time.

    `answers`: by words of a question; `faults`: of the emulator; `pull_nm`: what a person pulls at the lever;
    `rig_file`: keys that are put into the rig file; `plant`: changes anything else.
    """

    def __init__(
        self,
        settings: Mapping[str, Any] | None = None,
        faults: Mapping[str, Mapping[str, Any]] | None = None,
        rig_file: Mapping[str, Any] | None = None,
        answers: Mapping[str, bool] | None = None,
        arm: str | None = None,
        pull_nm: float = 5.0,
        plant: Callable[[Checked], None] = lambda _: None,
    ) -> None:
        self.world = World(1)
        self.settings = Settings(**{"noise_seed": 1, "noise_nm": 0.05, "rate_hz": 200.0, **(settings or {})})
        self.devices = make_devices(self.settings, arm, epoch_us=1_700_000_000_000_000)
        self.answers, self.pull_nm, self.questions = answers or {}, pull_nm, list[str]()
        for name, values in (faults or {}).items():
            self.devices.faults.on(name, dict(values))
        self.disk, self.computer = SimulatedDisk(self.world), Computer(self.world, 20.0, 1_764_000_000.0)
        self.process = Process(self.computer, self.disk, Wires(self.world, self.devices, 0.02, lambda *_: None))
        plant(self)
        content: dict[str, Any] = {
            "stimulator": {"device": self.settings.stimulator, "port": "/dev/stimrig/stimulator"},
            "load_cell": {
                "device": "can_load_cell", "bus": {"interface": "socketcan", "channel": "can0"},
                "sample_rate_hz": self.settings.rate_hz, **self.devices.load_cell.cell.rig_keys,
            },
            "angle_sensor": {"device": "can_angle_sensor"} if arm else None,
        }  # fmt: skip
        for key, value in (rig_file or {}).items():
            table, _, name = key.partition(".")
            content.setdefault(table, {})[name] = value
        self.config = config.check(content, "rig.toml", data_dir=FOLDER, socket=FOLDER / "socket")
        self.rig_check = RigCheck(self.config, self.process, self._answer, FOLDER / "check", emulated=False)
        self.steps = self._run()

    @property
    def outcomes(self) -> dict[str, str]:
        return {step.name: step.outcome for step in self.steps}

    @property
    def found(self) -> list[str]:
        return [step.fault for step in self.steps if step.fault]

    @property
    def pulses(self) -> list[Any]:
        return self.devices.electrodes.log

    def _run(self) -> list[Step]:
        done: list[Any] = []

        async def run() -> None:
            try:
                done.append(await self.rig_check.run(lambda _: None))
            except BaseException as error:
                done.append(error)

        self.process.post(lambda: self.process.tasks.spawn(run(), "check"))
        while not done and self.world.now_s < LONGEST_S:
            self.world.run(self.world.now_s + 0.5)
        if isinstance(done[0], BaseException):
            raise done[0]
        return done[0]

    def _answer(self, question: str) -> bool:
        """Do on the emulated devices what the question asks a person for."""
        self.questions.append(question)
        word = next(word for word in ("Pull", "Let go", "Bend", "Connect nobody") if question.startswith(word))
        if not self.answers.get(word, True):
            return False
        self.devices.advance(self.world.now_s)
        if word == "Pull":
            self.devices.faults.on("hung_weight", {"torque_nm": self.pull_nm})
        elif word == "Let go":
            self.devices.faults.off("hung_weight")
        elif word == "Bend":
            assert self.devices.limb is not None
            self.devices.limb.move("held", {"angle_deg": 110.0}, self.world.now_s)
        return True


PLANTED: dict[str, tuple[str, dict[str, Any]]] = {
    "stimulator off": ("stimulator", {"faults": {"no_ack": {}}}),
    "wrong bit rate": ("bit_rate", {"faults": {"wrong_bit_rate": {}}}),
    "cell not started": ("cell_silent", {"settings": {"cell": "canopen"}, "rig_file": {"load_cell.start_frames": []}}),
    "counter stuck": ("counter_stuck", {"faults": {"counter_stuck": {}}}),
    "termination missing": ("termination", {"faults": {"termination_missing": {}}}),
    "frames dropped": ("frames_lost", {"faults": {"frames_dropped": {"probability": 0.05}}}),
    "rate of the rig file": ("sample_rate", {"rig_file": {"load_cell.sample_rate_hz": 800.0}}),
    "cell reports a fault": ("no_number", {"faults": {"cell_reports_fault": {}}}),
    "noisy cell": ("noise", {"faults": {"torque_noisy": {}}}),
    "cell not tared": ("offset", {"settings": {"torque_offset_nm": 10.0}}),
    "cell upside down": ("torque_sign", {"faults": {"torque_sign_flipped": {}}}),
    "lever not connected": ("torque_unmoved", {"pull_nm": 0.0}),
    "angle sensor turned round": ("angle_sign", {"settings": {"angle_direction": -1}, "arm": "held"}),
    "stop line dead": ("stop", {"faults": {"stop_lost": {}}}),
    "load not connected": ("open_circuit", {"faults": {"electrode_error": {}}}),
    "sync line not wired": ("sync", {"faults": {"sync_unwired": {}}}),
}


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_fault_is_found_alone(name: str) -> None:
    fault, planted = PLANTED[name]
    checked = Checked(**planted)
    assert checked.found == [fault], checked.steps
    after = checked.steps[[step.fault for step in checked.steps].index(fault) + 1 :]
    assert {step.outcome for step in after} <= {"not done"}
    assert len(checked.pulses) <= (1 if fault in ("stop", "open_circuit", "sync") else 0)


@pytest.mark.parametrize("stimulator", ["p24", "rehastim2"])
@pytest.mark.parametrize("cell", ["plain", "canopen", "counts"])
def test_a_sound_rig_passes_with_one_small_pulse(stimulator: str, cell: str) -> None:
    checked = Checked({"stimulator": stimulator, "cell": cell}, arm="held" if cell == "plain" else None)
    assert set(checked.outcomes.values()) == {"passed"}, checked.steps
    assert [(one.width_us, one.current_ma, one.balanced) for one in checked.pulses] == [(WIDTH_US, CURRENT_MA, True)]


@pytest.mark.parametrize("word", ["Pull", "Connect nobody"])
def test_what_nobody_confirms_is_not_done_and_the_rig_is_not_called_sound(word: str) -> None:
    checked = Checked(answers={word: False})
    step = "test pulse" if word == "Connect nobody" else "sign of the torque"
    assert checked.outcomes[step] == "not done"
    assert verb.report(checked.steps, False, {})["verdict"] == "incomplete"
    assert len(checked.pulses) == (word == "Pull")


def test_no_pulse_while_somebody_pulls_at_the_lever() -> None:
    checked = Checked(answers={"Let go": False})
    assert checked.pulses == [] and checked.outcomes["test pulse"] == "failed", "above the torque limit of the pulse"


def test_limits_of_the_rig_file_hold() -> None:
    checked = Checked(rig_file={"limits.current_ma": 6.0, "limits.pulse_width_us": 50.0})
    assert [(one.width_us, one.current_ma) for one in checked.pulses] == [(50.0, 6.0)]


def test_torque_that_follows_the_pulse_is_found() -> None:
    """Somebody is connected instead of the load."""

    def connect(rig: Checked) -> None:
        pull = lambda nm, time_s: nm + (5.0 if rig.pulses and time_s - rig.pulses[-1].time_s < 0.1 else 0.0)  # noqa: E731
        rig.devices.load_cell.torque_hooks.append(pull)

    assert Checked(plant=connect).found == ["torque_follows"]


def test_no_pulse_comes_from_a_host_that_falls_silent() -> None:
    """The computer stands still from the question on: what was due meanwhile is never sent late."""

    class Silent(Checked):
        def _answer(self, question: str) -> bool:
            if question.startswith("Connect nobody"):
                self.world.at(self.world.now_s + 0.3, lambda: self.computer.pause(1.6))
            return super()._answer(question)

    checked = Silent()
    assert checked.pulses == [] and checked.outcomes["test pulse"] == "failed"


@pytest.mark.parametrize("left", [b'{"state": "running", "reason": "in a test"}', b"["])
def test_a_rig_that_died_in_a_test_is_not_checked(left: bytes) -> None:
    with pytest.raises(ConfigError, match="re-arm it, then check"):
        Checked(plant=lambda one: one.disk.replace(FOLDER / "latch.json", left))


# ---- ports


def rig_file(folder: Path, port: str | None = None) -> Path:
    path = folder / "rig.toml"
    path.write_text(
        f'data_dir = "{folder}/data"\nsocket = "{folder}/rig.sock"\n[stimulator]\ndevice = "p24"\n'
        f'port = "{port or folder / "nothing"}"\n[load_cell]\ndevice = "can_load_cell"\n'
        'bus = { interface = "socketcan", channel = "can99" }\n'
    )
    return path


def test_ports_are_looked_at_before_any_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "port").touch()
    there = config.load(rig_file(tmp_path, str(tmp_path / "port")))
    assert verb.check_ports(config.load(rig_file(tmp_path))).fault == "port_missing"
    assert verb.check_ports(there).fault == "can_down"
    for name, folder, content in (("TTY", tmp_path / "port" / "device", "16"), ("NET", tmp_path / "can99", "0x1")):
        folder = tmp_path / name / folder.relative_to(tmp_path)
        folder.mkdir(parents=True)
        (folder / ("latency_timer" if name == "TTY" else "flags")).write_text(content)
        monkeypatch.setattr(verb, name, tmp_path / name)
    assert verb.check_ports(there).fault == "latency_timer"
    (tmp_path / "TTY/port/device/latency_timer").write_text("1")
    assert verb.check_ports(there).outcome == "passed"


# ---- the process


def test_a_missing_port_is_told_with_its_remedy(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asked = ["rig", "check", "--rig", str(rig_file(tmp_path)), "--no-questions"]
    assert stimrig.run(asked) == 1
    out, err = capfd.readouterr()
    assert out.startswith("faults\n") and FAULTS["port_missing"][1] in out and "failed" in err
    assert verb.main(["--config", asked[3], "--no-questions"]) == 1
    report = json.loads(capfd.readouterr().out)
    assert unmet("rig", report) == [] and report["verdict"] == "faults"


def test_bad_input_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    no_file = str(tmp_path / "no.toml")
    for run, asked in (
        (stimrig.run, ["rig", "check"]),
        (stimrig.run, ["rig", "check", "--rig", "a", "--emulator-json", "b"]),
        (stimrig.run, ["rig", "check", "--rig", no_file]),
        (verb.main, ["--emulator-json", "{}"]),
    ):
        assert run(asked) == 2
        out, err = capfd.readouterr()
        assert out == "" and len(err.strip().splitlines()) == 1


def test_it_refuses_while_a_rig_uses_the_data_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "data").mkdir()
    with VirtualMachine().disk.lock(tmp_path / "data"):
        assert verb.main(["--config", str(rig_file(tmp_path))]) == 2
    assert "another rig" in capsys.readouterr().err
    assert verb.main(["--config", str(rig_file(tmp_path))]) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has other users' folders")
def test_root_checks_no_other_users_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Else the lock would be root's, and the rig could not start any more."""
    (tmp_path / "data").mkdir()
    os.chown(tmp_path / "data", 4711, 4712)
    assert verb.main(["--config", str(rig_file(tmp_path))]) == 2
    assert "sudo -u" in capsys.readouterr().err and list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize("closes", [True, False])
def test_a_signal_stops_the_rig_before_the_process_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], closes: bool
) -> None:
    """Whichever thread takes it, and also where a second one follows in the middle of the stop."""
    done: list[str] = []

    async def run(self: RigCheck, _report: Any) -> list[Step]:
        for number in (signal.SIGHUP, signal.SIGTERM):
            signal.pthread_kill(threading.get_ident(), number)
        await self.tasks.sleep(5)
        done.append("played on")
        return []

    async def close(self: Rig) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        await self._tasks.sleep(0.3 if closes else 30)
        done.append("stopped")

    monkeypatch.setattr(verb, "check_ports", lambda _: Step("ports", "passed", ""))
    monkeypatch.setattr(verb, "CLOSED_WITHIN_S", 20.0 if closes else 0.2)
    monkeypatch.setattr(RigCheck, "run", run)
    monkeypatch.setattr(Rig, "close", close)
    assert verb.main(["--config", str(rig_file(tmp_path))]) == (130 if closes else 2)
    assert done == (["stopped"] if closes else [])
    assert ("was stopped" if closes else "switch it off") in capsys.readouterr().err


def test_at_a_terminal_only_yes_is_yes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    answers = iter(["yes\n", "Y\n", "no\n", "perhaps\n", ""])
    monkeypatch.setattr("sys.stdin", type("In", (), {"readline": staticmethod(lambda: next(answers))})())
    assert [verb.ask_at_terminal("Is it so?") for _ in range(5)] == [True, True, False, False, False]
    assert "Is it so?" in capsys.readouterr().err


def test_the_page_lists_every_fault() -> None:
    page = (Path(__file__).parents[2] / "docs" / "rig-check.md").read_text("utf-8")
    assert [row for row in (f"| {cause} | {remedy} |" for cause, remedy in FAULTS.values()) if row not in page] == []
