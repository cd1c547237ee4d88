"""Effects of one's own: docs/add-an-effect.md, run; and a mistake, told at once with its file and line."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
from pathlib import Path

import pytest

import stimrig
from bench.muscles import hidden_records
from stimrig.api.cli import main
from stimrig.identify import effects
from tests.harness import few_effects

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "add-an-effect.md"


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    return found.group(1)


GOOD = block("python")


def answer(words: list[str]) -> str:
    """What a command says on standard output."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main.run(words) == 0
    return out.getvalue()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a record of a swinging amplifier, and the effect of the page in `my_effects`."""
    folder = tmp_path_factory.mktemp("own")
    record = hidden_records.generate("sensor_gain_swing", "strong", seed=1063, rate_hz=100, design="short")
    hidden_records.write_csv(record, folder / "record.csv")
    (folder / "my_effects").mkdir()
    (folder / "my_effects" / "sensor_gain_swing.py").write_text(GOOD, encoding="utf-8")
    return folder


def test_every_command_of_the_page_does_what_it_says(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside two of the library; that the library does not explain the record is asked above, of all of it."""
    monkeypatch.chdir(place)
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", "my_effects")
    outputs = {}
    for line in block("sh").splitlines():
        assignment, name, *words = line.split()
        assert (assignment, name) == ("STIMRIG_EFFECTS_DIR=my_effects", "stimrig")
        flags = [] if words[0] == "predict" else ["--json"]
        with few_effects.only("fatigue", "tremor"):
            outputs[words[0]] = answer(words + flags)
    assert "sensor_gain_swing" in [effect["id"] for effect in json.loads(outputs["effects"])["effects"]]
    found = json.loads(outputs["diagnose"])
    assert found["verdict"] == "effect_missing"
    first = found["missing"][0]
    assert first["effect"] == "sensor_gain_swing"
    assert first["rms_after_nm"] < 0.5 * first["rms_before_nm"]
    assert first["parameters"]["period_s"]["sd"] > 0
    steps = json.loads(outputs["improve"])["steps"]
    assert steps[1]["added"] == "sensor_gain_swing"
    model = json.loads((place / "MODEL.json").read_text())
    assert "sensor_gain_swing" in [effect["id"] for effect in model["effects"]]
    assert (place / "predicted.csv").stat().st_size > 1000


# ---- mistakes ----


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
        ('stage="output"', 'stage="outputs"', "no stage is called 'outputs'. Give one of pulse_width, gain, branch"),
        ('"log", about="period"', '"logarithmic", about="period"', "scale 'logarithmic'"),
        ("1.5, 30.0, 10.0", "30.0, 1.5, 10.0", "bounds 30.0 to 1.5"),
        ("1.5, 30.0, 10.0", "1.5, 30.0, None", "a bound or a start that is no number"),
        ("(5.0,)", "(5.0,) * 10000", "10000 starts. Give 32 at most"),
        ('id="sensor_gain_swing"', 'needs="angle_rad", id="sensor_gain_swing"', "needs 'angle_rad'"),
        ("(5.0,)", "(0.2,)", "is not within 1.5 and 30.0"),
        ("EFFECT = Effect(", "EFFEKT = Effect(", "no EFFECT in it"),
        ("EFFECT = Effect(", "EFFECT = dict(", "EFFECT is a dict, not an Effect"),
        ("        apply=swing,\n", "", "no apply"),
        ("    return torque_nm * (1", "    return torque_nm, (1", "apply gives 160 numbers, not one for each of 80"),
    ],
)
def test_what_cannot_be_an_effect_is_told_with_its_file(tmp_path, monkeypatch, old: str, new: str, says: str) -> None:
    assert old in GOOD
    line = told(tmp_path, monkeypatch, GOOD.replace(old, new))
    assert line.startswith(str(tmp_path / "mine.py")) and says in line, line


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("def swing(torque_nm, p, scene):", "def swing(torque_nm, p, scene)", "SyntaxError: expected ':'"),
        ("import numpy as np", "import numppy as np", "ModuleNotFoundError: No module named 'numppy'"),
        ("EFFECT = Effect(", "1 / 0\nEFFECT = Effect(", "ZeroDivisionError: division by zero"),
        ("EFFECT = Effect(", "exit()\nEFFECT = Effect(", "SystemExit"),
        ('p["period_s"]', 'p["period"]', "apply fails: KeyError: 'period'"),
        ('p["period_s"]', "exit()", "apply fails: SystemExit"),
    ],
)
def test_an_error_in_the_file_is_told_with_its_line(tmp_path, monkeypatch, old: str, new: str, says: str) -> None:
    text, first = GOOD.replace(old, new, 1), new.splitlines()[0]
    number = next(number for number, line in enumerate(text.splitlines(), start=1) if first in line)
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, Path("my_effects")):  # as the page names it, too: from where one works
        line = told(folder, monkeypatch, text)
        assert line.startswith(f"{folder / 'mine.py'}, line {number}") and says in line, line


def test_a_folder_that_is_not_there_is_told(tmp_path, monkeypatch) -> None:
    for name, says in (("nowhere", "no such folder"), ("file.py", "a file, not a folder")):
        (tmp_path / "file.py").write_text("")
        monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path / name))
        with pytest.raises(effects.BadEffect, match=rf"STIMRIG_EFFECTS_DIR=.*{name}: {says}\. Name the folder"):
            effects.registry()


def test_two_files_of_one_id_are_told(tmp_path, monkeypatch) -> None:
    (tmp_path / "again.py").write_text(GOOD)
    assert "is also in " in told(tmp_path, monkeypatch, GOOD)


@pytest.mark.parametrize("at", ["    return torque_nm", "EFFECT = Effect("])
@pytest.mark.parametrize("caught", ["ValueError", "TimeoutError", "BaseException"])
def test_a_loop_without_an_end_is_told_with_its_line(tmp_path, monkeypatch, at: str, caught: str) -> None:
    monkeypatch.setattr(effects, "TRIAL_S", 1.2)  # a machine may pause for 0.8 s
    dent = at[: -len(at.lstrip())]
    loop = f"while True:\n{dent}    try:\n{dent}        pass\n{dent}    except {caught}:\n{dent}        break"
    line = told(tmp_path, monkeypatch, GOOD.replace(at, f"{dent}{loop}\n{at}", 1))
    assert re.match(rf"{tmp_path / 'mine.py'}, line \d+: not done after 1.2 s\. See docs", line), line


@pytest.mark.parametrize("end", ["import ctypes; ctypes.string_at(0)", "raise KeyboardInterrupt"])
def test_an_effect_that_ends_python_is_told_with_its_line(tmp_path, monkeypatch, end: str) -> None:
    folder = tmp_path / "ü"
    line = told(folder, monkeypatch, GOOD.replace("EFFECT = Effect(", f"{end}\nEFFECT = Effect("))
    assert re.match(rf"{folder / 'mine.py'}, line \d+: it ends Python\.", line), line


def test_an_effect_that_ends_python_without_an_error_is_told_with_its_folder(tmp_path, monkeypatch) -> None:
    line = told(tmp_path, monkeypatch, "import os; os._exit(0)")
    assert line.startswith(f"{tmp_path}: it ends Python.")


def test_what_an_effect_starts_does_not_prolong_its_trial(tmp_path, monkeypatch) -> None:
    pids = tmp_path / "pids"
    start = f"import os\npid = os.posix_spawnp('sleep', ['sleep', '600'], os.environ)\nfile = open({str(pids)!r}, 'a')"
    try:
        assert "no EFFECT in it" in told(tmp_path, monkeypatch, f"{start}\nprint(pid, file=file, flush=True)")
    finally:
        in_the_trial, here = (int(pid) for pid in pids.read_text().split())
        for pid in (in_the_trial, here):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(here, 0)


def test_a_module_of_the_current_folder_is_not_loaded(tmp_path, monkeypatch) -> None:
    (tmp_path / "numba.py").write_text("raise SystemExit(3)")
    (tmp_path / "effects").mkdir()
    monkeypatch.chdir(tmp_path)
    assert "no EFFECT in it" in told(tmp_path / "effects", monkeypatch, "")


@pytest.mark.parametrize("known", ["fatigue", "free_width_by_torque"])
def test_an_own_effect_takes_no_name_of_the_library(tmp_path, monkeypatch, known: str) -> None:
    line = told(tmp_path, monkeypatch, GOOD.replace('id="sensor_gain_swing"', f'id="{known}"'))
    assert line == f"{tmp_path / 'mine.py'}: the effect '{known}' is also in the library. Give it another id."


def test_the_command_line_says_it_in_one_line(tmp_path: Path, monkeypatch, capsys) -> None:
    (tmp_path / "mine.py").write_text(GOOD.replace('stage="output"', 'stage="outptu"'))
    monkeypatch.setenv("STIMRIG_EFFECTS_DIR", str(tmp_path))
    assert main.run(["effects"]) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1
    line = f"stimrig effects: {tmp_path / 'mine.py'}, form 'sine': no stage is called 'outptu'"
    assert told.err.startswith(line)


def test_an_effect_that_is_not_found_names_the_way_to_its_file() -> None:
    with pytest.raises(stimrig.errors.BadRequest, match=r"set STIMRIG_EFFECTS_DIR to the folder with its .*fatigue"):
        effects.find_effect("sensor_gain_swing")
