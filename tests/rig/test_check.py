"""The check of a rig, in simulated time: each planted fault is told with its mend, a sound rig passes, and no pulse
flows that should not."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

from stimrig.rig import config
from stimrig.rig.check import __main__ as verb
from stimrig.rig.check import steps
from stimrig.rig.check.bench import CURRENT_MA, WIDTH_US
from stimrig.rig.check.person import QUESTIONS, AtTerminal, Scripted
from stimrig.rig.check.surroundings import Surroundings
from stimrig.rig.control.checked import Checked as LastCheck
from stimrig.rig.control.checked import fingerprint
from stimrig.rig.control.rig import Rig
from stimrig.rig.errors import CheckNeededError, ConfigError
from stimrig.rig.messages import Profile, TestPlan
from stimrig.rig.requests import CalibrateStartRequest
from tests.harness.rig_checks import FOLDER, Checked, Planted
from tests.harness.rig_faults import PLANTED, WITHOUT_SYNC, sound_rigs
from tests.simulator.virtual_time import VirtualMachine

PAGE = Path(__file__).parents[2] / "docs" / "rig-check.md"


@pytest.fixture(scope="module")
def sound() -> Checked:
    return Checked(Planted("sound"))


def outcomes(checked: Checked) -> dict[str, str]:
    return {row["name"]: row["outcome"] for row in checked.report["steps"]}


# ---- faults and sound rigs


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: planted.name)
def test_a_planted_fault_is_told_with_its_mend(planted: Planted) -> None:
    checked = Checked(planted)
    assert checked.found == [planted.fault], checked.told
    assert checked.report["verdict"] == "faults"
    (row,) = (row for row in checked.report["steps"] if row["fault"])
    assert (row["cause"], row["mend"]) == steps.faults()[planted.fault]
    assert row["cause"] and row["mend"] and row["figure"]


@pytest.mark.parametrize(
    ("planted", "seed", "noise_nm"), list(sound_rigs(10))[::3], ids=lambda one: getattr(one, "name", one)
)
def test_a_sound_rig_passes(planted: Planted, seed: int, noise_nm: float) -> None:
    checked = Checked(planted, seed, noise_nm)
    assert (checked.report["verdict"], checked.found) == ("sound", []), checked.told


def test_every_fault_is_planted_or_cannot_be() -> None:
    """What the emulator cannot do: a person instead of the load, and what is only another word for the same."""
    others = {
        "torque_follows",
        "computer_busy",
        "torque_stale",
        "train_ended",
        "rig_went_on",
        "same_port",
        "can_missing",
        "adapter_fails",
        "wrong_dbc",
        "cell_constant",
        "cell_unmoved",
        "angle_unmoved",
        "angle_silent",
        "pulse_unanswered",
        "pulses_dropped",
        "sync_wrong",
        "current_wrong",
        "stop_unconfirmed",
        "torque_unseen",
        "stop_late",
        "stimulator_faulty",
    }
    planted = {one.fault for one in PLANTED}
    assert planted | others == set(steps.faults()) and not planted & others
    assert len(planted) >= 20


# ---- what flows


def test_pulses_are_few_small_and_balanced(sound: Checked) -> None:
    pulses = sound.devices.electrodes.log
    assert {(one.width_us, one.current_ma) for one in pulses} == {(WIDTH_US, CURRENT_MA)}
    assert WIDTH_US * CURRENT_MA * 1e-3 <= 2.0, "µC: no more than the first train of a calibration"
    assert all(one.balanced for one in pulses) and len(pulses) < 400


def test_no_pulse_without_a_persons_word_on_the_load() -> None:
    for answers in ({"load": "no"}, {"load": ""}, {"load": "2.1"}, {"load": "yes"}):
        checked = Checked(Planted("no load"), answers=answers)
        assert checked.devices.electrodes.log == []
        assert checked.report["verdict"] != "sound"
        assert {outcomes(checked)[name] for name in ("pulses", "stop", "silence", "emergency")} == {"not done"}


@pytest.mark.parametrize("left", [b'{"state": "running", "reason": "in a test"}', b"["])
def test_a_rig_that_died_in_a_test_is_not_checked(left: bytes) -> None:
    """Its latch waits for a person; a check would play beside it, in a folder of its own."""
    with pytest.raises(ConfigError, match="re-arm it, then check"):
        Checked(Planted("died", world=lambda one: one.disk.replace(FOLDER / "latch.json", left)))


def test_limits_of_the_rig_file_hold() -> None:
    checked = Checked(Planted("tight", rig_file={"limits.current_ma": 6.0, "limits.pulse_width_us": 50.0}))
    pulses = checked.devices.electrodes.log
    assert pulses and {(one.width_us, one.current_ma) for one in pulses} == {(50.0, 6.0)}


def test_torque_that_follows_the_pulses_ends_the_check() -> None:
    """Somebody is connected instead of the load."""

    def connect(rig: Checked) -> None:
        log = rig.devices.electrodes.log
        pull = lambda nm, time_s: nm + (5.0 if log and time_s - log[-1].time_s < 0.1 else 0.0)  # noqa: E731
        rig.devices.load_cell.torque_hooks.append(pull)

    checked = Checked(Planted("a person is connected", world=connect))
    assert checked.found == ["torque_follows"], checked.told
    assert len(checked.devices.electrodes.log) <= 4
    assert outcomes(checked)["stop"] == outcomes(checked)["emergency"] == "not done"


def test_after_a_fault_that_was_not_provoked_nothing_is_played() -> None:
    checked = Checked(Planted("load off", faults={"electrode_error": {}}))
    assert len(checked.devices.electrodes.log) == 1
    assert {outcomes(checked)[name] for name in ("scope", "stop", "silence", "emergency")} == {"not done"}


@pytest.mark.parametrize(
    ("before", "undone"),
    [("width and current at the load", ("stop", "silence", "emergency")), ("watchdog", ("emergency",))],
)
@pytest.mark.parametrize("kind", ["person", "loose cable"])
def test_a_train_that_a_fault_has_ended_does_not_count_as_stopped(
    monkeypatch: pytest.MonkeyPatch, before: str, undone: tuple[str, ...], kind: str
) -> None:
    """Somebody is connected, or a cable comes off, once that step is done: the stop that follows ends no train."""

    def fail(rig: Checked) -> None:
        class Told(list[Any]):
            def append(self, one: Any) -> None:
                super().append(one)
                if kind != "person" and one[0] == before:
                    rig.devices.faults.on("electrode_error", {})

        told, log = Told(), rig.devices.electrodes.log
        monkeypatch.setattr(Checked, "told", property(lambda _: told, lambda *_: None), raising=False)
        new = lambda: kind == "person" and any(title == before for title, _ in told)  # noqa: E731
        pull = lambda nm, time_s: nm + (5.0 if new() and time_s - log[-1].time_s < 0.1 else 0.0)  # noqa: E731
        rig.devices.load_cell.torque_hooks.append(pull)

    checked = Checked(Planted("later", world=fail))
    assert {outcomes(checked)[name] for name in undone} == {"not done"}, checked.told
    assert checked.report["verdict"] == "incomplete"


def test_a_weight_that_stays_on_the_lever_lets_no_pulse_flow() -> None:
    checked = Checked(Planted("weight left"), answers={"weight_off": ""})
    assert checked.devices.electrodes.log == []


# ---- the report


def test_the_report_is_kept_and_says_what_it_must(sound: Checked) -> None:
    kept = json.loads(sound.disk.read(FOLDER / "check.json"))
    assert kept == sound.report
    assert kept["verdict"] == "sound" and kept["by"] == "the emulator" and kept["rig"] == fingerprint(sound.config)
    assert kept["devices"]["stimulator"]["serial_number"] == "EMULATED24", "the device tells it"
    assert kept["devices"]["load_cell"]["serial_number"] == "emulated", "it was asked for"
    assert kept["due_at_utc"] > kept["checked_at_utc"]


def test_what_nobody_answers_is_not_done_and_the_rig_is_not_called_sound() -> None:
    checked = Checked(Planted("no weight"), answers={"weight_on": ""})
    assert outcomes(checked)["weight"] == "not done" and checked.report["verdict"] == "incomplete"
    checked = Checked(Planted("no oscilloscope"), answers={"scope": ""})
    assert outcomes(checked)["scope"] == "not done" and checked.report["verdict"] == "sound", "it needs an instrument"
    with pytest.raises(ConfigError, match="--by"):
        Checked(Planted("nobody"), answers={"by": ""})


def test_without_a_sync_line_a_person_is_asked_whether_pulses_flow_in_the_silence() -> None:
    checked = Checked(Planted("no sync", settings=dict(WITHOUT_SYNC)), answers={"scope_silent": ""})
    assert outcomes(checked)["silence"] == "not done" and checked.report["verdict"] == "incomplete"


def test_who_answers() -> None:
    person = Scripted({"unplug:biceps": "yes", "weight_on": "no"})
    assert person.ask("unplug", name="biceps") == "yes" and person.ask("unplug", name="triceps") is None
    assert all(words.format_map(_Any()) for words in QUESTIONS.values())


def test_at_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    answers = iter(["Jo\n", "\n"])
    monkeypatch.setattr("sys.stdin.readline", lambda: next(answers), raising=False)
    monkeypatch.setattr("sys.stdin", type("In", (), {"readline": staticmethod(lambda: next(answers))})())
    assert AtTerminal().ask("by") == "Jo" and AtTerminal().ask("by") is None
    assert "Who does this check?" in capsys.readouterr().err


class _Any(dict[str, Any]):
    def __missing__(self, key: str) -> float:
        return 1.0


# ---- due again; required


def rig_of(checked: Checked, **keys: Any) -> Rig:
    """A rig of the same devices, after the process of the check."""
    checked.disk.process_ended()
    return Rig(checked.config.model_copy(update=keys), checked.process, lambda _: None)


def live(checked: Checked, make: Any) -> Any:
    """A coroutine in the simulated time of a check that is over: what it returns or raises."""
    done: list[Any] = []

    async def run() -> None:
        try:
            done.append(await make())
        except Exception as error:
            done.append(error)

    def begin() -> None:
        checked.process.tasks.spawn(run(), "test")

    checked.process.post(begin)
    while not done:
        checked.world.run(checked.world.now_s + 0.5)
    return done[0]


PLAN = TestPlan(test_id="t", participant="P", profile=Profile.model_validate({}), segments=None)


def test_a_rig_file_may_require_a_check(sound: Checked) -> None:
    kept = sound.disk.read(FOLDER / "check.json")
    sound.disk.remove(FOLDER / "check.json")
    rig = rig_of(sound, require_check=True, require_calibration=False)
    live(sound, rig.open)
    refused = live(sound, lambda: rig.start(PLAN))
    assert isinstance(refused, CheckNeededError) and "never checked" in str(refused)
    asked = CalibrateStartRequest.model_validate(
        {"kind": "calibrate-start", "id": 1, "calibration_id": "c", "participant": "P", "by": "nurse"}
    )
    assert isinstance(live(sound, lambda: rig.calibrations.start(asked)), CheckNeededError)
    live(sound, rig.close)
    sound.disk.replace(FOLDER / "check.json", kept)
    rig = rig_of(sound, require_check=True, require_calibration=False)
    live(sound, rig.open)
    found = rig.status().check
    assert found is not None and found.verdict == "sound" and found.due == ""
    assert live(sound, lambda: rig.start(PLAN)).state in ("arming", "running")
    live(sound, rig.close)


def last_check(tmp_path: Path, content: dict[str, Any] | str | None, **keys: Any) -> LastCheck:
    machine = VirtualMachine()
    rig = config.check(
        {
            "data_dir": tmp_path,
            "socket": tmp_path / "s",
            "stimulator": {"device": "p24", "port": "/dev/x"},
            "load_cell": {"device": "can_load_cell", "bus": {"interface": "socketcan", "channel": "can0"}},
            **keys,
        },
        "rig.toml",
    )
    if isinstance(content, dict):
        content = json.dumps({"rig": fingerprint(rig), **content})
    if content is not None:
        (tmp_path / "check.json").write_text(content)
    found = LastCheck(rig, machine)
    found.recall()
    return found


SOUND = {
    "verdict": "sound",
    "checked_at_utc": "2023-11-01T00:00:00.000Z",
    "due_at_utc": "2023-12-01T00:00:00.000Z",
    "by": "Jo",
}
"""The virtual clock begins on 14 November 2023."""


@pytest.mark.parametrize(
    ("content", "due"),
    [
        (SOUND, ""),
        ({**SOUND, "due_at_utc": "2023-11-10T00:00:00.000Z"}, "due again"),
        ({**SOUND, "verdict": "faults"}, "not sound"),
        ({**SOUND, "verdict": "incomplete"}, "not sound"),
        ({**SOUND, "rig": "another"}, "has changed"),
        (None, "never"),
        ("not JSON", "never"),
        ("[" * 100_000, "never"),
        ("{}", "never"),
        ({**SOUND, "due_at_utc": "tomorrow"}, "never"),
    ],
)
def test_why_a_check_is_due(tmp_path: Path, content: Any, due: str) -> None:
    found = last_check(tmp_path, content, require_check=True)
    status = found.status()
    assert status is not None
    if due:
        assert due in status.due
        with pytest.raises(CheckNeededError, match=due):
            found.refuse()
    else:
        assert status.due == ""
        found.refuse()
    told = last_check(tmp_path, content)
    told.refuse()  # told, not refused, where the rig file does not require it
    assert told.status() is not None


def test_a_rig_for_no_person_does_not_ask_for_a_check(tmp_path: Path) -> None:
    assert last_check(tmp_path, None, require_calibration=False).status() is None


def test_place_and_socket_are_not_part_of_the_rig(sound: Checked) -> None:
    moved = sound.config.model_copy(update={"data_dir": Path("/other"), "require_check": True})
    assert fingerprint(moved) == fingerprint(sound.config)
    limits = sound.config.limits.model_copy(update={"current_ma": 5.0})
    assert fingerprint(sound.config.model_copy(update={"limits": limits})) != fingerprint(sound.config)


def test_another_description_of_the_frames_is_another_rig(sound: Checked, tmp_path: Path) -> None:
    """A scale in the DBC file counts as much as one in the rig file."""
    described = tmp_path / "cell.dbc"

    def seen(text: str) -> str:
        described.write_text(text)
        settings = sound.config.load_cell.model_copy(update={"dbc": str(described)})
        return fingerprint(sound.config.model_copy(update={"load_cell": settings}))

    assert seen("(0.01,0)") == seen("(0.01,0)") != seen("(0.001,0)")


# ---- the process


def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(
        f'data_dir = "{tmp_path}/data"\nsocket = "{tmp_path}/rig.sock"\n[stimulator]\ndevice = "p24"\n'
        f'port = "{tmp_path}/nothing"\n[load_cell]\ndevice = "can_load_cell"\n'
        'bus = { interface = "socketcan", channel = "can99" }\n'
    )
    return path


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(rig_file(tmp_path))
    for words in (
        ["--config", "nowhere.toml"],
        ["--config", file, "--dummy-load-ohm", "-1"],
        ["--config", file, "--days", "nan"],
        ["--config", file, "--weight-nm", "nan"],
        ["--config", file, "--answer", "colour=blue"],
        ["--config", file, "--no-questions"],
    ):
        assert verb.main(words) == 2
        out, err = capsys.readouterr()
        assert out == "" and len(err.strip().splitlines()) == 1 and err.startswith("check: "), err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_whatever_ends_it_stops_the_stimulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    """A train is running: the rig is stopped and closed before the process ends."""
    closed: list[bool] = []

    async def train(bench: Any, *_: Any) -> dict[str, Any]:
        os.kill(os.getpid(), number)
        await bench.tasks.sleep(30)
        return {}

    async def close(_self: Rig) -> None:
        closed.append(True)

    monkeypatch.setattr(verb, "run", train)
    monkeypatch.setattr(Rig, "close", close)
    handler = signal.getsignal(number)
    assert verb.main(["--config", str(rig_file(tmp_path)), "--answer", "by=me"]) == 130
    assert closed and "was stopped" in capsys.readouterr().err
    assert signal.getsignal(number) == handler


def test_signals_at_once_neither_get_lost_nor_cut_the_stop_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A closed terminal: SIGHUP and SIGTERM at once, of which the kernel may give both to a thread that plays."""
    told: list[str] = []

    async def train(bench: Any, *_: Any) -> dict[str, Any]:
        for number in (signal.SIGHUP, signal.SIGTERM):
            signal.pthread_kill(threading.get_ident(), number)
        await bench.tasks.sleep(5)
        told.append("played on")
        return {}

    async def close(self: Rig) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        await self._tasks.sleep(0.5)
        told.append("stopped")

    monkeypatch.setattr(verb, "run", train)
    monkeypatch.setattr(Rig, "close", close)
    assert verb.main(["--config", str(rig_file(tmp_path)), "--answer", "by=me"]) == 130
    assert told == ["stopped"] and "was stopped" in capsys.readouterr().err


def test_a_stop_that_does_not_end_is_not_told_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def train(bench: Any, *_: Any) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGTERM)
        await bench.tasks.sleep(5)
        return {}

    async def close(self: Rig) -> None:
        await self._tasks.sleep(30)

    monkeypatch.setattr(verb, "run", train)
    monkeypatch.setattr(verb, "CLOSED_WITHIN_S", 0.2)
    monkeypatch.setattr(Rig, "close", close)
    assert verb.main(["--config", str(rig_file(tmp_path)), "--answer", "by=me"]) == 2
    assert "switch it off" in capsys.readouterr().err


def test_it_refuses_while_a_rig_uses_the_data_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(rig_file(tmp_path))
    (tmp_path / "data").mkdir()
    lock = VirtualMachine().disk.lock(tmp_path / "data")
    assert verb.main(["--config", file, "--answer", "by=me"]) == 2
    assert "another rig" in capsys.readouterr().err
    with lock:
        pass
    assert verb.main(["--config", file, "--answer", "by=me"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["rig_file"] == file and len(report["rig_file_sha256"]) == 64
    assert [row["fault"] for row in report["steps"] if row["fault"]] == ["port_missing"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_what_root_checks_the_rigs_user_reads(tmp_path: Path) -> None:
    (tmp_path / "check" / "one").mkdir(parents=True)
    (tmp_path / "check.json").write_text("{}")
    os.chown(tmp_path, 4711, 4712)
    verb.give_to_owner(tmp_path)
    for path in (tmp_path / "check.json", tmp_path / "check" / "one"):
        assert (path.stat().st_uid, path.stat().st_gid) == (4711, 4712)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.parametrize("place", ["check", "check/one"])
def test_root_gives_nothing_away_through_a_link(tmp_path: Path, place: str) -> None:
    """The rig's user, who owns the folder, has put a link to a folder of root's into it."""
    data, other = tmp_path / "data", tmp_path / "other"
    (data / place).parent.mkdir(parents=True)
    (other / "inside").mkdir(parents=True)
    (other / "inside" / "shadow").touch()
    (data / place).symlink_to(other)
    os.chown(data, 4711, 4712)
    verb.give_to_owner(data)
    assert {path.stat().st_uid for path in (other, *other.rglob("*"))} == {os.geteuid()}


def test_what_the_system_says(tmp_path: Path) -> None:
    see = Surroundings()
    file = tmp_path / "port"
    assert not see.exists(str(file))
    file.touch()
    assert see.exists(str(file)) and see.may_use(str(file)) and see.holder(str(file)) == ""
    assert see.usb_id(str(file)) == "" and see.latency_ms(str(file)) is None and see.can_link("no-such-link") is None


# ---- the page


def test_the_table_of_the_page_is_that_of_the_code() -> None:
    text, rows = PAGE.read_text("utf-8"), []
    for step in steps.library().values():
        rows += [f"| {step.TITLE} | {fault.cause} | {fault.mend} |" for fault in step.FAULTS.values()]
    missing = [row for row in rows if row not in text]
    assert not missing, "\n".join(missing)
    assert text.count("\n| ") >= len(rows)
    assert all(f"`{name}`" in text for name in QUESTIONS)
