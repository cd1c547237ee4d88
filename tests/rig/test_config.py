"""The rig file: every mistake is one line that names the key and the mend."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from stimrig.hardware_sim.load_cells import CELLS
from stimrig.hardware_sim.load_cells.frames import Sample
from stimrig.hardware_sim.stimulators import STIMULATORS
from stimrig.rig import config
from stimrig.rig.devices import find, library
from stimrig.rig.errors import ConfigError
from stimrig.rig.machine import Frame
from tests.harness.processes import CLINIC_WATCH
from tests.simulator.virtual_time import VirtualMachine

GOOD = """
data_dir = "var"
socket = "var/rig.sock"
[stimulator]
device = "p24"
port = "/dev/ttyACM0"
[load_cell]
device = "can_load_cell"
bus = { interface = "socketcan", channel = "can0" }
[limits]
pulse_width_us = 400
torque_nm = 25
"""


def load(tmp_path: Path, text: str) -> config.RigConfig:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return config.load(path)


def test_a_good_file(tmp_path: Path):
    loaded = load(tmp_path, GOOD)
    assert loaded.clock_speed == 1.0
    table = loaded.limits.table()
    assert table["pulse_width_us"].hi == 400
    assert table["pulse_width_us"].owner == "rig file"
    assert (table["torque_nm"].lo, table["torque_nm"].hi) == (-25, 25)
    assert loaded.public()["stimulator"]["port"] == "/dev/ttyACM0"
    json.dumps(loaded.public())


def test_a_limit_is_never_widened(tmp_path: Path):
    assert load(tmp_path, GOOD.replace("400", "4000")).limits.table()["pulse_width_us"].hi == 500


def test_the_example_is_good():
    path = Path(__file__).parents[2] / "deploy" / "rig.example.toml"
    loaded = config.load(path)
    assert find("load_cell", loaded.load_cell.device).create(loaded.load_cell, None).sample_rate_hz == 1600
    assert loaded.require_calibration
    rest = loaded.limits.table()["rest_between_tests_s"]
    assert (rest.lo, rest.owner) == (60.0, "rig file")


def test_the_examples_of_the_page_are_complete(tmp_path: Path):
    page = (Path(__file__).parents[2] / "docs" / "rig-file.md").read_text("utf-8")
    examples = [text for text in re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S) if "data_dir" in text]
    loaded = [load(tmp_path, text) for text in examples]
    assert [(one.stimulator.device, one.load_cell.model_dump()["bus"]["interface"]) for one in loaded] == [
        ("rehastim2", "socketcan"),
        ("p24", "slcan"),
    ]
    for one in loaded:
        one.limits.table()
        find("load_cell", one.load_cell.device).create(one.load_cell, VirtualMachine())


MISTAKES = {
    "unknown device": (('"p24"', '"p42"'), "stimulator.device: unknown device 'p42'; use one of: p24"),
    "unknown key": (("port =", "prot ="), "stimulator.p"),
    "text in a number": (("400", '"wide"'), "limits.pulse_width_us: Input should be a valid number"),
    "NaN": (("400", "nan"), "limits.pulse_width_us"),
    "negative": (("400", "-4"), "limits.pulse_width_us"),
    "no TOML": (("[limits]", "[limits"), "not TOML"),
    "missing table": (("[load_cell]", "[cell]"), "[load_cell] is missing"),
    "missing key": (('socket = "var/rig.sock"', ""), "socket: missing"),
    "a faster clock": (("data_dir", "clock_speed = 2\ndata_dir"), "clock_speed: only an emulator's clock"),
    "the world's clock": (("data_dir", "clock_speed = 1.0\ndata_dir"), "clock_speed: only an emulator's clock"),
    "truth for a number": (("400", "true"), "limits.pulse_width_us: Input should be a valid number"),
    "a number for truth": (("data_dir", "require_calibration = 0\ndata_dir"), "require_calibration"),
    "patience without end": (("[limits]", "[watch]\nmissing_ack_s = inf\n[limits]"), "watch.missing_ack_s"),
    "truth for patience": (("[limits]", "[watch]\nstale_disk_s = true\n[limits]"), "watch.stale_disk_s"),
    "channel": (("port =", "channel = 9\nport ="), "stimulator.channel"),
    "start frame": (("bus =", 'start_frames = ["0-0100"]\nbus ='), "write id#data in hex"),
    "scale": (("bus =", "scale_nm = 0\nbus ="), "scale of 0"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line(tmp_path: Path, name: str):
    (old, new), words = MISTAKES[name]
    assert old in GOOD
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, GOOD.replace(old, new))
    line = str(caught.value)
    assert words in line
    assert "rig.toml" in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("signal", "Torque", "has no signal 'Torque'"),
        ("counter", "Count", "did you mean 'Counter'?"),
        ("sync", "sink", "has no sync 'sink'"),
        ("message", "Torqe", "did you mean 'Torque'?"),
        ("dbc", "nowhere/cell.dbc", "no file"),
    ],
)
def test_a_wrong_signal_is_named(tmp_path: Path, key: str, value: str, words: str):
    loaded = load(tmp_path, GOOD.replace("bus =", f'{key} = "{value}"\nbus ='))
    with pytest.raises(ConfigError, match=words) as caught:
        find("load_cell", "can_load_cell").create(loaded.load_cell, None)
    assert str(caught.value).startswith("load_cell.")


def test_a_file_that_is_not_there(tmp_path: Path):
    with pytest.raises(ConfigError, match="No such file"):
        config.load(tmp_path / "none.toml")


def test_the_emulators_line(tmp_path: Path):
    line = json.dumps({"stimulator": "/dev/pts/3", "can": {"interface": "slcan", "channel": "/dev/pts/4"}, "speed": 5})
    where = {"data_dir": tmp_path, "socket": tmp_path / "s"}
    loaded = config.for_emulator(line, **where)
    assert loaded.clock_speed == 5
    assert loaded.stimulator.model_dump()["port"] == "/dev/pts/3"
    (tmp_path / "ready.json").write_text(line)
    assert config.for_emulator(str(tmp_path / "ready.json"), **where) == loaded
    (tmp_path / "list.json").write_text("[1]")
    for wrong in ("{}", "[1]", str(tmp_path / "none"), str(tmp_path / "list.json")):
        with pytest.raises(ConfigError, match="--emulator-json"):
            config.for_emulator(wrong, **where)


def test_half_a_second_is_the_emulators_alone(tmp_path: Path):
    """A rig file waits 0.1 s; so does a bench that gives the emulator's line the watch of a rig file."""
    line = {"stimulator": "/dev/pts/3", "can": {"interface": "slcan", "channel": "/dev/pts/4"}}
    where = {"data_dir": tmp_path, "socket": tmp_path / "s"}
    made = [config.for_emulator(json.dumps(line | more), **where) for more in ({}, {"watch": CLINIC_WATCH})]
    waits = [
        (m.watch.stale_torque_s, m.watch.missing_ack_s, m.watch.clipped_torque_s) for m in (load(tmp_path, GOOD), *made)
    ]
    assert waits == [(0.1, 0.1, 3.0), (0.5, 0.5, 10.0), (0.1, 0.1, 3.0)]


def test_the_emulators_line_never_leads_to_a_real_stimulator(tmp_path: Path):
    """It sets the clock's speed and asks for no calibration: 600 pulses in a second would be its doing."""
    real = tmp_path / "ttyACM0"
    real.touch()
    (tmp_path / "link").symlink_to(real)
    (tmp_path / "dangling").symlink_to("/dev/ttyACM9")
    absent = ("/dev/ttyACM9", "/dev/pts/../ttyACM9", str(tmp_path / "dangling"))  # there is one when it is opened
    for port in (str(real), "/dev/null", str(tmp_path / "link"), *absent):
        line = json.dumps({"stimulator": port, "can": {"interface": "virtual"}, "speed": 20})
        with pytest.raises(ConfigError, match="is not a pseudo-terminal of an emulator"):
            config.for_emulator(line, data_dir=tmp_path, socket=tmp_path / "s")


def test_the_command_line_makes_no_rig_file_faster(tmp_path: Path):
    (tmp_path / "rig.toml").write_text(GOOD)
    with pytest.raises(ConfigError, match=r"--clock-speed with .*only an emulator's clock"):
        config.load(tmp_path / "rig.toml", clock_speed=2.0)


@pytest.mark.parametrize("cell", [(name, count) for name, kind in CELLS.items() for count in kind.layouts])
@pytest.mark.parametrize("stimulator", library("stimulator"))
def test_every_emulated_device_has_its_description(tmp_path: Path, stimulator: str, cell: tuple[str, int]):
    """The rig reads from an emulated cell's frame what that put into it, and every driver has an emulated device."""
    assert set(library("stimulator")) == set(STIMULATORS)
    name, count = cell
    emulated = CELLS[name](count)
    line = {
        "stimulator": "/dev/pts/3", "stimulator_device": stimulator, "can": {"interface": "slcan", "channel": "x"},
        "cell": name, "load_cell": emulated.rig_keys,
    }  # fmt: skip
    loaded = config.for_emulator(json.dumps(line), data_dir=tmp_path, socket=tmp_path / "s")
    assert loaded.stimulator.device == stimulator
    assert bool(loaded.load_cell.model_dump()["start_frames"]) == (not emulated.running)
    device = find("load_cell", "can_load_cell").create(loaded.load_cell, None)
    assert (device.counter_modulus > 0) == emulated.has_counter == (name != "counts")
    samples = [Sample(torque_nm, 40 * count + i, False, 0) for i, torque_nm in enumerate((1.5, -2.5, 0.5, 7.0)[:count])]
    frame = emulated.encode(samples)
    assert frame.can_id == device._frame.message.frame_id
    read = device.decode([Frame(frame.can_id, frame.data, 1.0, 1.0)])
    assert read.samples["torque_nm"] == pytest.approx([sample.torque_nm for sample in samples], abs=2e-3)
