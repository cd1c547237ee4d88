"""Effects of one's own: a mistake is told at once, in one line with the file and the line in it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from stimrig.identify import effects
from stimrig.identify.effects import own_file

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "add-an-effect.md"


def good() -> str:
    found = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    return found.group(1)


def line_of(text: str, words: str) -> int:
    return next(number for number, line in enumerate(text.splitlines(), start=1) if words in line)


def told(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> str:
    folder.mkdir(exist_ok=True)
    (folder / "mine.py").write_text(text, encoding="utf-8")
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(folder))
    with pytest.raises(effects.BadEffect) as caught:
        effects.registry()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('stage="output"', 'stage="outputs"', "no stage is called 'outputs'. Give one of pulse_width, gain, speed"),
        ('"log", about="period"', '"logarithmic", about="period"', "scale 'logarithmic'"),
        ("1.5, 30.0, 10.0", "30.0, 1.5, 10.0", "bounds 30.0 to 1.5"),
        ("1.5, 30.0, 10.0", "1.5, float('inf'), 10.0", "bounds 1.5 to inf"),
        ("(5.0,)", "(0.2,)", "is not within 1.5 and 30.0"),
        ("1.5, 30.0, 10.0", "0.0, 30.0, 10.0", "a logarithmic scale from 0 or below"),
        ('id="sensor_gain_swing"', 'id="Sensor gain"', "id 'Sensor gain'"),
        ("EFFECT = Effect(", "EFFEKT = Effect(", "no EFFECT in it"),
        ("EFFECT = Effect(", "EFFECT = dict(", "EFFECT is a dict, not an Effect"),
        ("        apply=swing,\n", "", "no apply"),
    ],
)
def test_what_cannot_be_an_effect_is_told_with_its_file(tmp_path, monkeypatch, old: str, new: str, says: str) -> None:
    assert old in good()
    line = told(tmp_path, monkeypatch, good().replace(old, new))
    assert line.startswith(str(tmp_path / "mine.py")) and says in line, line


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("def swing(torque_nm, p, scene):", "def swing(torque_nm, p, scene)", "SyntaxError: expected ':'"),
        ("import numpy as np", "import numppy as np", "ModuleNotFoundError: No module named 'numppy'"),
        ("EFFECT = Effect(", "1 / 0\nEFFECT = Effect(", "ZeroDivisionError: division by zero"),
        ("EFFECT = Effect(", "exit()\nEFFECT = Effect(", "SystemExit"),
        ('p["period_s"]', 'p["period"]', "apply fails: KeyError: 'period'"),
    ],
)
def test_an_error_in_the_file_is_told_with_its_line(tmp_path, monkeypatch, old: str, new: str, says: str) -> None:
    text = good().replace(old, new, 1)
    line = told(tmp_path, monkeypatch, text)
    number = line_of(text, new.splitlines()[0])
    assert line.startswith(f"{tmp_path / 'mine.py'}, line {number}") and says in line, line


def test_a_folder_that_is_not_there_is_told(tmp_path, monkeypatch) -> None:
    for name, says in (("nowhere", "no such folder"), ("file.py", "a file, not a folder")):
        (tmp_path / "file.py").write_text("")
        monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path / name))
        with pytest.raises(effects.BadEffect, match=rf"STIMRIG_EFFECTS_DIR=.*{name}: {says}\. Name the folder"):
            effects.registry()


def test_two_files_of_one_id_are_told(tmp_path, monkeypatch) -> None:
    (tmp_path / "again.py").write_text(good())
    assert "is also in " in told(tmp_path, monkeypatch, good())


def test_the_librarys_own_effects_keep_what_is_asked_of_a_users() -> None:
    for name, effect in effects.registry().items():
        assert own_file.checked(effect, name) is effect


@pytest.mark.parametrize("verb", [["effects"], ["fit", "nothing.csv", "--effects", "fatigue"], ["diagnose", "r.csv"]])
def test_the_command_line_says_it_in_one_line(tmp_path: Path, verb: list[str]) -> None:
    rows = "".join(f"{k / 40},{100 * (k // 20 % 2)},{0.1 * (k % 7)},prbs\n" for k in range(400))
    (tmp_path / "r.csv").write_text("time_s,pulse_width_us,torque_nm,segment\n" + rows)
    (tmp_path / "nothing.csv").write_text((tmp_path / "r.csv").read_text())
    (tmp_path / "mine.py").write_text(good().replace('stage="output"', 'stage="outptu"'))
    environment = {"STIMRIG_EFFECTS_DIR": str(tmp_path), "PYTHONPATH": str(PAGE.parents[1])}
    command = [sys.executable, "-m", "stimrig.api.cli", *verb]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"stimrig {verb[0]}: {tmp_path / 'mine.py'}, form 'sine': no stage is called 'outptu'")
