"""The verbs: what they print, what they refuse, and with which exit code."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from bench.muscles import hidden_records
from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.cli.commands.diagnose import diagnosis_lines
from stimrig.api.progress_bar import progress_bar
from stimrig.identify.healing import place_words
from tests.api.test_jobs import made_up_csv
from tests.harness import few_effects

pytestmark = pytest.mark.slow


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main.run(list(map(str, arguments)))
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """One line on standard error, nothing on standard output, exit 2."""
    code, out, err = run(capsys, *arguments)
    assert code == 2, (out, err)
    assert out == ""
    assert err.count("\n") == 1 and "Traceback" not in err, err
    return err


def of_another_tool(record: Path, folder: Path) -> Path:
    """The same record with semicolons, decimal commas, milliseconds, N·cm, and names of its own."""
    lines = ["Zeit;Breite;Kraftmoment;segment"]
    for row in record.read_text().splitlines()[1:]:
        time_s, width_us, torque_nm, segment = row.split(",")
        lines.append(f"{float(time_s) * 1e3:.4f};{width_us};{float(torque_nm) * 100:.8f};{segment}".replace(".", ","))
    path = folder / "other.csv"
    path.write_text("\n".join(lines))
    return path


MAP = ["--map", "time_s=Zeit:ms", "--map", "pulse_width_us=Breite:µs", "--map", "torque_nm=Kraftmoment:N·cm"]


def test_a_record_of_another_tool_gives_the_same_and_what_was_assumed_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, record: Path
) -> None:
    other = of_another_tool(record, tmp_path)
    with few_effects.only("fatigue", "tremor"):
        code, out, err = run(capsys, "diagnose", other, *MAP, "--json")
        plain = json.loads(run(capsys, "diagnose", record, "--json")[1])
    assert code == 0 and err == f"{other}: semicolons between cells, decimal commas\n"
    found = json.loads(out)
    assert found["base"]["fit_percent"] == pytest.approx(plain["base"]["fit_percent"], abs=1e-3)
    assert found["verdict"] == plain["verdict"]
    assert "Kraftmoment" in refused(capsys, "diagnose", str(other))


def test_models_and_predictions_as_mat_files(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, record: Path, model: Path
) -> None:
    from scipy.io import loadmat

    assert run(capsys, "fit", str(record), "-o", str(tmp_path / "M.mat"))[0] == 0
    held = loadmat(tmp_path / "M.mat", squeeze_me=True, struct_as_record=False)
    linear = json.loads(model.read_text())["linear"]
    assert held["linear"].b == pytest.approx(linear["b"])
    assert sum(linear["b"]) / sum(linear["a"]) == pytest.approx(1.0, abs=1e-6), "unit gain at DC"
    assert run(capsys, "predict", str(model), str(record), "-o", str(tmp_path / "p.mat"))[0] == 0
    found = loadmat(tmp_path / "p.mat", squeeze_me=True)
    assert found["predicted_torque_nm"].shape == found["time_s"].shape == (1000,)
    assert "MODEL.json of the same fit" in refused(capsys, "compare", str(tmp_path / "M.mat"), str(record))


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A record, another one with an angle, and files that cannot be used."""
    folder = tmp_path_factory.mktemp("several")
    files = {name: folder / f"{name}.csv" for name in ("plain", "moved", "short", "bad")}
    made_up_csv(files["plain"])
    head, *rows = (row.split(",") for row in files["plain"].read_text().splitlines())
    more = [f"{t},{w},{0.97 * float(nm):.6f},{s},{0.8 + 0.001 * k:.4f},0.04" for k, (t, w, nm, s) in enumerate(rows)]
    files["moved"].write_text("\n".join([",".join([*head, "angle_rad", "velocity_rad_s"]), *more]))
    files["short"].write_text("\n".join(files["plain"].read_text().splitlines()[:6]))
    files["bad"].write_text("time_s,pulse_width_us,torque_nm,segment\n0.0,0,0.1,prbs\n0.025,abc,0.1,prbs\n")
    return files


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("fit {bad} --json", "bad.csv, line 3, column pulse_width_us: 'abc'"),
        ("fit nowhere.csv", "nowhere.csv"),
        ("fit .", "."),
        ("fit {plain} {plain}", "named twice"),
        ("fit {plain} {short}", "short.csv"),
        ("fit {record} --method magic", "magic"),
        ("fit {record} --effects phlogiston", "phlogiston"),
        ("fit {record} --fit-on polka", "polka"),
        ("fit {record} --effects auto,tremor", "tremor"),
        ("fit {record} --effects auto --method narx", "narx"),
        ("fit {record} --effects tremor,phlogiston", "phlogiston"),
        ("fit {record} --carry {model} --effects fatigue", "Leave out --method, --effects and --fit-on."),
        ("diagnose {record} --model nowhere.json", "nowhere.json"),
        ("improve {record} --model nowhere.json", "nowhere.json"),
        ("diagnose {record} --model {record}", "record.csv"),
        ("fit {record} -o /nowhere/at/all/M.json", "/nowhere/at/all/M.json"),
        ("predict nowhere.json {record} -o x.csv", "nowhere.json"),
        ("predict {record} {record} -o x.csv", "record.csv"),
        ("predict {model} {record} -o /nowhere/x.csv", "/nowhere/x.csv"),
        ("compare {model} nowhere.csv", "nowhere.csv"),
        ("table1 --trials 0", "--trials"),
        ("fit", "DATA"),
        ("fit {record} --nonsense", "--nonsense"),
        ("polka", "polka"),
        ("serve --port 99999", "--port"),
    ],
)
def test_bad_arguments_are_one_line(
    capsys: pytest.CaptureFixture[str], record: Path, model: Path, parts: dict[str, Path], line: str, named: str
) -> None:
    assert named in refused(capsys, *line.format(record=record, model=model, **parts).split())


@pytest.mark.parametrize("verb", ["diagnose", "improve"])
def test_a_model_that_cannot_be_criticised_on_this_record_is_refused(
    capsys: pytest.CaptureFixture[str], record: Path, model: Path, tmp_path: Path, verb: str
) -> None:
    other, boxes = tmp_path / "other.json", tmp_path / "narx.json"
    other.write_text(json.dumps({**json.loads(model.read_text()), "pulse_rate_hz": 25.0}))
    words = refused(capsys, verb, str(record), "--model", str(other))
    assert "other.json" in words and "25 pulses a second" in words
    assert main.run(["fit", str(record), "--method", "narx", "-o", str(boxes)]) == 0
    assert "effects cannot be added to a model of narx" in refused(capsys, verb, str(record), "--model", str(boxes))


def test_progress_tells_share_and_text_to_who_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stimrig.api.progress_bar.PATIENCE_S", 0.0)
    for looks in (True, False):
        shown = io.StringIO()
        shown.isatty = lambda looks=looks: looks
        monkeypatch.setattr("sys.stderr", shown)
        with progress_bar() as progress:
            for share in (0.25, 0.5):
                progress(share, "tried tremor")
        lines = [" ".join(line.split()) for line in shown.getvalue().split("\r")]
        assert any(line.startswith("50 %") and line.endswith("left tried tremor") for line in lines) == looks
        assert lines[-1] == "", "nothing stays behind it"


def test_unforeseen_error_is_one_line_and_a_log(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, record: Path
) -> None:

    monkeypatch.setattr(identify, "fit", Mock(side_effect=ZeroDivisionError("odd")), raising=False)
    code, out, err = run(capsys, "fit", str(record))
    assert code == 1 and out == "" and err.count("\n") == 1
    log = Path(err.rsplit("(log: ", 1)[1].rstrip(")\n"))
    assert "ZeroDivisionError" in log.read_text()
    log.unlink()


CONTRACT = "serve emulate test demo doctor rig fit predict compare diagnose improve explain invert recover export"


def test_every_verb_of_the_contract_is_there_and_helps() -> None:
    done = subprocess.run([sys.executable, "-m", "stimrig", "--help"], capture_output=True, text=True, check=True)
    for verb in [*CONTRACT.split(), "backup", "erase", "audit", "cohort", "effects", "table1"]:
        assert f"\n  {verb} " in done.stdout, verb


def test_emulate_hands_everything_on() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "stimrig", "emulate", "--patient", "nobody"], capture_output=True, text=True
    )
    assert done.returncode == 2 and "nobody" in done.stderr and done.stderr.count("\n") == 1
    helped = subprocess.run(
        [sys.executable, "-m", "stimrig", "emulate", "--help"], capture_output=True, text=True, check=True
    )
    assert "--hidden SEED" in helped.stdout


@pytest.mark.parametrize("given", [[], ["audit"]])
def test_without_a_verb_the_help_is_told_line_by_line(given, capsys):
    assert main.run(given) == 2
    told = capsys.readouterr().err
    assert told.startswith("Usage:") and len(told.splitlines()) > 6


def test_a_verb_does_not_wait_for_the_libraries_of_others():
    code = "import sys; from stimrig.api.cli.main import build; build('diagnose'); print('sqlalchemy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_fit_of_two_is_of_both(parts: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, both = tmp_path / "MODEL.json", (parts["plain"], parts["moved"])
    code, out, err = run(capsys, "fit", *both, "-o", model, "--json")
    assert code == 0, err
    assert "plain.csv: no angle_rad, so it is left out of the joined record" in err
    assert json.loads(out)["data"]["recording_id"] == "plain.csv + moved.csv"
    code, out, err = run(capsys, "compare", model, *both, "--html", tmp_path / "report.html")
    assert code == 0 and "plain.csv and " in out, err
    assert "plain.csv, moved.csv" in (tmp_path / "report.html").read_text("utf-8")
    with few_effects.only("fatigue", "baseline_drift"):
        code, out, err = run(capsys, "diagnose", *both, "--model", model, "--json")
    assert code == 0 and json.loads(out)["verdict"], err
    code, out, err = run(capsys, "fit", *both, "--effects", "torque_angle")
    assert code == 2 and out == "" and "plain.csv: it has no angle_rad" in err and err.count("\n") == 1


def test_a_fit_after_an_earlier_one_says_which_structure_it_offers(
    record: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, out = ("fit", record, "--carry", model), tmp_path / "new.json"
    assert "offered: the plain structure" in run(capsys, *words, "-o", out)[1]
    found = json.loads(run(capsys, *words, "--json")[1])
    assert found["extra"]["carried"]["offered"] == json.loads(out.read_text())["extra"]["carried"]["offered"] == "plain"


# ---- From a record with something hidden in it to a better model's prediction, through the command line alone


def stimrig(*words: object) -> str:
    """Standard output of a verb that must succeed; of two effects it finds what is missing."""
    out, err = io.StringIO(), io.StringIO()
    few = few_effects.only("fatigue", "output_saturation")
    with few, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run(list(map(str, words)))
    assert code == 0, err.getvalue()
    return out.getvalue()


@pytest.fixture(scope="module")
def tired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of a muscle that tires, and what `improve` makes of it."""
    folder = tmp_path_factory.mktemp("tired")
    record = hidden_records.generate("fatigue", "strong", seed=41, rate_hz=100, design="short")
    data = folder / "record.csv"
    hidden_records.write_csv(record, data)
    made = ("-o", folder / "better.json", "--html", folder / "report.html")
    (folder / "improved.json").write_text(stimrig("improve", data, *made, "--json"))
    return folder


def test_improve_writes_a_model_that_predicts_better(tired: Path, tmp_path: Path) -> None:
    data, base, better = tired / "record.csv", tmp_path / "base.json", tired / "better.json"
    stimrig("fit", data, "-o", base)
    found = json.loads((tired / "improved.json").read_text())
    assert [step["added"] for step in found["steps"]][:2] == [None, "fatigue"]
    assert found["steps"][1]["rms_nm"] < found["steps"][0]["rms_nm"]
    assert (tired / "report.html").stat().st_size > 1000

    def rms_nm(model: Path) -> float:
        out = tmp_path / f"{model.stem}.csv"
        stimrig("predict", model, data, "-o", out)
        with out.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        assert list(rows[0]) == ["time_s", "torque_nm", "predicted_torque_nm"]
        gap = [float(row["torque_nm"]) - float(row["predicted_torque_nm"]) for row in rows]
        return float(np.sqrt(np.mean(np.square(gap))))

    assert rms_nm(better) < 0.5 * rms_nm(base)


def test_what_a_model_holds_is_not_missing_in_it_and_auto_adds_what_improve_adds(tired: Path, tmp_path: Path) -> None:
    data, held = tired / "record.csv", tmp_path / "held.json"
    fitted = json.loads(stimrig("fit", data, "--effects", "auto", "-o", held, "--json"))
    improved = json.loads((tired / "improved.json").read_text())
    added = [step["added"] for step in improved["steps"][1:]]
    assert [effect["id"] for effect in fitted["effects"]] == added and "fatigue" in added
    forms = [f"{effect['id']} ({effect['form']})" for effect in fitted["effects"]]
    own = json.loads(stimrig("diagnose", data, "--model", held, "--json"))
    assert f"structure      {', '.join(forms)}" in diagnosis_lines(own)
    assert [name.partition(":")[0] for name in own["structure"]] == added
    assert own["verdict"] == "nothing_missing" and own["missing"] == []
    tried = {row["effect"] for rows in own["candidates"] for row in rows}
    assert tried and not tried & set(added)
    assert own["base"]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    report = tmp_path / "report.html"
    further = json.loads(stimrig("improve", data, "--model", held, "--html", report, "--json"))
    assert [name.partition(":")[0] for name in further["structure"]] == added
    assert [step["added"] for step in further["steps"]] == [None] and further["verdict"] == "nothing_missing"
    assert further["steps"][0]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    assert "fatigue" in report.read_text().lower()


def test_explain_tells_how_the_error_falls_and_agrees_with_the_other_verbs(tired: Path, tmp_path: Path) -> None:
    data, model, page, figures = tired / "record.csv", tmp_path / "m.json", tmp_path / "s.html", tmp_path / "figures"
    found = json.loads(stimrig("explain", data, "-o", model, "--html", page, "--figures", figures, "--json"))
    improved = json.loads((tired / "improved.json").read_text())
    assert {**found["improvement"], "steps": _without_ids(found["improvement"])} == {
        **{name: improved[name] for name in found["improvement"]}, "steps": _without_ids(improved)
    }  # fmt: skip
    added = [step["added"] for step in improved["steps"][1:]]
    assert found["diagnosis"]["add"] == added and found["diagnosis"]["conclusion"]["advice"].startswith("Add “Fatigue”")
    assert (
        found["left"]["conclusion"] == json.loads(stimrig("diagnose", data, "--model", model, "--json"))["conclusion"]
    )
    assert found["places"] and all(place["after_nm"] < place["before_nm"] for place in found["places"])
    assert all(place_words(place) in page.read_text() for place in found["places"]), "the same in words and numbers"
    noise_nm = found["diagnosis"]["noise_sd_nm"]
    assert any(place["healed"] and place["before_nm"] > 1.3 * noise_nm for place in found["places"])
    text = page.read_text()
    assert text.count('class="still"') == 3
    names = {f"{name}.{kind}" for name in ("story-torque", "story-place", "falling") for kind in ("svg", "pdf", "png")}
    assert {path.name for path in figures.iterdir()} == names
    for path in figures.iterdir():
        assert path.read_bytes().startswith({".svg": b"<svg", ".pdf": b"%PDF", ".png": b"\x89PNG"}[path.suffix])
        assert b"rgba(" not in path.read_bytes() and b"var(--" not in path.read_bytes()


def _without_ids(improved: dict) -> list[dict]:
    return [{key: value for key, value in step.items() if key != "model_id"} for step in improved["steps"]]
