"""`stimrig rig init`: what is found, asked and written; nothing is opened, nothing is overwritten."""

from __future__ import annotations

import json
import shlex
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from stimrig.rig import config
from stimrig.rig.setup import __main__ as verb
from stimrig.rig.setup import ports as found
from stimrig.rig.setup.ports import Found, proposed

P24 = SimpleNamespace(device="/dev/ttyACM0", vid=0x0483, pid=0x5740, serial_number="A1", description="x")
CANABLE = SimpleNamespace(device="/dev/ttyACM1", vid=0x16D0, pid=0x117E, serial_number=None, description="y")
OTHER = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None, description="n/a")


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What this machine has: serial ports, CAN interfaces, a person's lines at a terminal (None: no terminal)."""
    has: dict[str, Any] = {"ports": [], "links": [], "lines": None}
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: has["ports"])
    monkeypatch.setattr(found, "can_interfaces", lambda: has["links"])
    monkeypatch.setattr("serial.Serial.open", lambda *_: pytest.fail("a port was opened"))
    typed = SimpleNamespace(
        isatty=lambda: has["lines"] is not None,
        readline=lambda: (has["lines"] or [""]).pop(0) if has["lines"] else "\n",
    )
    monkeypatch.setattr("sys.stdin", typed)
    return has


def made(path: Path, *words: str) -> dict[str, Any]:
    assert verb.main(["-o", str(path), *words]) == 0
    return tomllib.loads(path.read_text("utf-8"))


def test_the_defaults_are_a_rig_file_with_a_comment_for_each_key(tmp_path: Path, machine: dict[str, Any]) -> None:
    path = tmp_path / "rig.toml"
    made(path, "--yes")
    loaded = config.load(path)
    assert loaded.require_calibration and loaded.limits.current_ma == 60
    keys = [line for line in path.read_text("utf-8").splitlines() if " = " in line and not line.startswith("#")]
    assert len(keys) > 12 and all("  # " in line for line in keys)


def test_ports_are_proposed_by_their_usb_numbers(tmp_path: Path, machine: dict[str, Any]) -> None:
    machine["ports"] = [OTHER, CANABLE, P24]
    content = made(tmp_path / "rig.toml", "--yes")
    assert content["stimulator"] == {"device": "p24", "port": "/dev/ttyACM0", "connector": 1, "channel": 1}
    assert content["load_cell"]["bus"] == {"interface": "slcan", "channel": "/dev/ttyACM1", "bitrate": 1000000}
    machine["links"] = ["can7"]
    assert made(tmp_path / "other.toml", "--yes")["load_cell"]["bus"]["channel"] == "can7"


def test_names_by_udev_go_before_the_kernels(
    tmp_path: Path, machine: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tty").touch()
    (tmp_path / "stimrig").mkdir()
    (tmp_path / "stimrig" / "stimulator").symlink_to(tmp_path / "tty")
    monkeypatch.setattr(found, "NAMES", tmp_path / "stimrig")
    machine["ports"] = [SimpleNamespace(**{**vars(P24), "device": str(tmp_path / "tty")})]
    (port,) = found.serial_ports()
    assert port.name == str(tmp_path / "stimrig" / "stimulator") and "0483:5740" in port.words and "A1" in port.words


def test_of_two_alike_none_is_proposed() -> None:
    two = [Found("/dev/a", "p24", ""), Found("/dev/b", "p24", "")]
    assert proposed(two, "p24") == "" and proposed(two[:1], "p24") == "/dev/a"


def test_a_person_answers(tmp_path: Path, machine: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    machine["lines"] = ["rehastim2\n", "/dev/stimrig/ftdi-A1\n", "biceps=1,triceps=5\n", *["\n"] * 30]
    content = made(tmp_path / "rig.toml", "--sync", "-", "--scale-nm", "0.25")
    assert [(one["name"], one["channel"]) for one in content["stimulator"]["channels"]] == [
        ("biceps", 1),
        ("triceps", 5),
    ]
    assert content["load_cell"]["sync"] == "" and content["load_cell"]["scale_nm"] == 0.25
    asked = capsys.readouterr().err
    assert (
        "Serial port of the stimulator" in asked and "sync" not in asked.split("found")[1].partition("Signal of the")[0]
    )


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--sample-rate-hz", "fast"], "must be a number"),
        (["--limit-current-ma", "nan"], "must be a number"),
        (["--limit-current-ma", "700"], "not tighter"),
        (["--limit-rest-between-tests-s", "0.5"], "not tighter"),
        (["--channels", "red"], "--channels red"),
        (["--channels", "9.9"], "stimulator.c"),
        (["--stimulator", "toaster"], "toaster"),
        (["--dbc", "nowhere.dbc"], "nowhere.dbc"),
    ],
)
def test_a_wrong_answer_is_one_line_and_writes_nothing(
    words: list[str], says: str, tmp_path: Path, machine: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert verb.main(["-o", str(tmp_path / "rig.toml"), "--yes", *words]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("setup: ") and says in last
    assert list(tmp_path.iterdir()) == []


def test_where_nobody_can_be_asked_nothing_is_taken_for_granted(
    tmp_path: Path, machine: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert verb.main(["-o", str(tmp_path / "rig.toml"), "--stimulator", "p24"]) == 2
    assert "--port: nobody is there to ask; give it, or --yes" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path, machine: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("mine")
    assert verb.main(["-o", str(path), "--yes"]) == 2
    assert path.read_text() == "mine" and "it exists" in capsys.readouterr().err
    assert verb.main(["-o", str(tmp_path / "no" / "rig.toml"), "--yes"]) == 2
    assert "No such file" in capsys.readouterr().err


def test_what_is_typed_stays_one_value(
    tmp_path: Path, machine: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.toml"
    content = made(path, "--yes", "--port", '/dev/a"\n[limits]\ncurrent_ma = 99\x7f', "--data-dir", "/a\\b")
    assert content["stimulator"]["port"] == '/dev/a"\n[limits]\ncurrent_ma = 99\x7f'
    assert content["data_dir"] == "/a\\b" and content["limits"]["current_ma"] == 60
    assert json.loads(capsys.readouterr().out)["rig_file"] == str(path)


def test_the_command_of_the_page(tmp_path: Path, machine: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "rig-check.md").read_text("utf-8")
    (line,) = (line for line in page.splitlines() if line.startswith("stimrig rig init -o out/"))
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    assert verb.main(shlex.split(line)[3:]) == 0
    content = tomllib.loads((tmp_path / "out" / "rig.toml").read_text("utf-8"))
    assert content["stimulator"]["device"] == "rehastim2" and content["limits"]["current_ma"] == 40
