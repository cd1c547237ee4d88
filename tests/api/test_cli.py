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
from stimrig.api.progress_bar import progress_bar
from stimrig.identify.healing import place_words
from tests.api.test_jobs import made_up_csv
from tests.api.test_schemas import unmet
from tests.harness import few_effects

pytestmark = pytest.mark.slow


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main.run(list(map(str, arguments)))
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """One line on standard error, nothing on standard output, exit 2."""
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "") and err.count("\n") == 1 and "Traceback" not in err, err
    return err


def printed(*words: object) -> str:
    """Standard output of a verb that must succeed; of two effects it finds what is missing."""
    out, err = io.StringIO(), io.StringIO()
    few = few_effects.only("fatigue", "output_saturation")
    with few, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main.run(list(map(str, words)))
    assert code == 0, err.getvalue()
    return out.getvalue()


def of_another_tool(record: Path, path: Path) -> Path:
    """The same record with semicolons, decimal commas, milliseconds, N·cm, and names of its own."""
    lines = ["Zeit;Breite;Kraftmoment;segment"]
    for row in record.read_text().splitlines()[1:]:
        time_s, width_us, torque_nm, segment = row.split(",")
        lines.append(f"{float(time_s) * 1e3:.4f};{width_us};{float(torque_nm) * 100:.8f};{segment}".replace(".", ","))
    path.write_text("\n".join(lines))
    return path


MAP = ["--map", "time_s=Zeit:ms", "--map", "pulse_width_us=Breite:µs", "--map", "torque_nm=Kraftmoment:N·cm"]


def test_a_record_of_another_tool_gives_the_same_and_what_was_assumed_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, record: Path, model: Path
) -> None:
    other = of_another_tool(record, tmp_path / "other.csv")
    code, out, err = run(capsys, "fit", other, *MAP, "--json")
    assert code == 0 and err == f"{other}: semicolons between cells, decimal commas\n"
    own = json.loads(model.read_text())
    assert json.loads(out)["fit"]["fit_percent"] == pytest.approx(own["fit"]["fit_percent"], abs=1e-3)
    assert "Kraftmoment" in refused(capsys, "diagnose", other)


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory, model: Path) -> dict[str, Path]:
    """A record, another one with an angle, and files that cannot be used."""
    folder = tmp_path_factory.mktemp("several")
    names = {"plain": "csv", "moved": "csv", "short": "csv", "bad": "csv", "rate": "json"}
    files = {name: folder / f"{name}.{suffix}" for name, suffix in names.items()}
    made_up_csv(files["plain"])
    head, *rows = (row.split(",") for row in files["plain"].read_text().splitlines())
    more = [f"{t},{w},{0.97 * float(nm):.6f},{s},{0.8 + 0.001 * k:.4f},0.04" for k, (t, w, nm, s) in enumerate(rows)]
    files["moved"].write_text("\n".join([",".join([*head, "angle_rad", "velocity_rad_s"]), *more]))
    files["short"].write_text("\n".join(files["plain"].read_text().splitlines()[:6]))
    files["bad"].write_text("time_s,pulse_width_us,torque_nm,segment\n0.0,0,0.1,prbs\n0.025,abc,0.1,prbs\n")
    files["rate"].write_text(json.dumps({**json.loads(model.read_text()), "pulse_rate_hz": 25.0}))
    return files


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("fit {bad} --json", "bad.csv, line 3, column pulse_width_us: 'abc'"),
        ("fit nowhere.csv", "nowhere.csv"),
        ("fit .", "."),
        ("fit {plain} {plain}", "Name each recording once"),
        ("fit {plain} {short}", "short.csv"),
        ("fit {plain} {moved} --effects torque_angle", "plain.csv: it has no angle_rad"),
        ("fit {record} --method magic", "magic"),
        ("fit {record} --effects phlogiston", "phlogiston"),
        ("fit {record} --fit-on polka", "polka"),
        ("fit {record} --effects tremor --method narx", "narx"),
        ("fit {record} --effects tremor,phlogiston", "phlogiston"),
        ("fit {record} --carry {model} --effects fatigue", "Leave out --method, --effects and --fit-on."),
        ("diagnose {record} --model nowhere.json", "nowhere.json"),
        ("improve {record} --model nowhere.json", "nowhere.json"),
        ("diagnose {record} --model {record}", "record.csv"),
        ("diagnose {record} --model {rate}", "rate.json: "),
        ("improve {record} --model {rate}", "25 pulses a second"),
        ("fit {record} -o /nowhere/at/all/M.json", "/nowhere/at/all/M.json: No such file"),
        ("predict nowhere.json {record} -o x.csv", "nowhere.json"),
        ("predict {record} {record} -o x.csv", "record.csv"),
        ("predict {model} {record} -o /nowhere/x.csv", "/nowhere/x.csv: "),
        ("predict {model} {record} -o {model}/x.csv", "MODEL.json/x.csv: Not a directory"),
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
    capsys.readouterr()
    code = main.run(line.format(record=record, model=model, **parts).split())
    out, err = capsys.readouterr()
    notes = [words for words in err.splitlines() if "so it is left out of the joined record" in words]
    assert (code, out) == (2, "") and len(err.splitlines()) - len(notes) == 1 and named in err, err


def test_serve_starts_no_emulated_rig_where_a_rig_has_a_socket(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    start = Mock(side_effect=AssertionError("it starts a rig"))
    monkeypatch.setattr("stimrig.api.cli.commands.serve.Services", start)
    monkeypatch.setenv("STIMRIG_RIG_SOCKET", str(tmp_path / "rig.sock"))
    assert "python -m stimrig.api.web" in refused(capsys, "serve", "--data", tmp_path)
    assert not start.called


def test_a_model_that_no_effect_stands_on_is_refused(
    capsys: pytest.CaptureFixture[str], record: Path, tmp_path: Path
) -> None:
    boxes = tmp_path / "narx.json"
    assert main.run(["fit", str(record), "--method", "narx", "-o", str(boxes)]) == 0
    assert "effects cannot be added to a model of narx" in refused(capsys, "diagnose", record, "--model", boxes)


@pytest.mark.parametrize("looks", [True, False])
def test_progress_tells_share_and_text_to_who_looks(monkeypatch: pytest.MonkeyPatch, looks: bool) -> None:
    monkeypatch.setattr("stimrig.api.progress_bar.PATIENCE_S", 0.0)
    shown = io.StringIO()
    shown.isatty = lambda: looks
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
    code, out, err = run(capsys, "fit", record)
    assert code == 1 and out == "" and err.count("\n") == 1
    log = Path(err.rsplit("(log: ", 1)[1].rstrip(")\n"))
    assert "ZeroDivisionError" in log.read_text()
    log.unlink()


CONTRACT = (
    "serve emulate test demo doctor rig fit predict compare diagnose improve explain invert recover export backup "
    "erase audit cohort effects table1"
)


@pytest.mark.parametrize("given", ["--help", "", "audit"])
def test_the_help_lists_the_verbs_line_by_line(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, *given.split())
    assert (code, out if code else err) == (0 if given == "--help" else 2, "")
    for verb in ("verify", "export") if given == "audit" else CONTRACT.split():
        assert f"\n  {verb} " in out + err, verb


def test_emulate_hands_everything_on() -> None:
    done = subprocess.run([sys.executable, "-m", "stimrig", "emulate", "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "") and "--hidden SEED" in done.stdout


def test_a_verb_does_not_wait_for_the_libraries_of_others() -> None:
    code = "import sys; from stimrig.api.cli.main import build; build('diagnose'); print('sqlalchemy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_fit_of_two_is_of_both(parts: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, report, both = tmp_path / "MODEL.json", tmp_path / "report.html", (parts["plain"], parts["moved"])
    code, out, err = run(capsys, "fit", *both, "-o", model, "--json")
    assert code == 0 and "plain.csv: no angle_rad, so it is left out of the joined record" in err, err
    assert json.loads(out)["data"]["recording_id"] == "plain.csv + moved.csv"
    code, out, err = run(capsys, "compare", model, *both, "--html", report)
    assert code == 0 and "plain.csv, moved.csv" in out and "plain.csv, moved.csv" in report.read_text("utf-8"), err


def test_a_fit_after_an_earlier_one_says_which_structure_it_offers(
    record: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, out = ("fit", record, "--carry", model, "-o", tmp_path / "new.json"), tmp_path / "new.json"
    assert "plain offered" in run(capsys, *words)[1]
    assert json.loads(out.read_text())["extra"]["carried"]["offered"] == "plain"


# ---- From a record with something hidden in it to a better model's prediction, through the command line alone


@pytest.fixture(scope="module")
def tired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of a muscle that tires, and what `improve` makes of it."""
    folder = tmp_path_factory.mktemp("tired")
    record = hidden_records.generate("fatigue", "strong", seed=41, rate_hz=100, design="short")
    hidden_records.write_csv(record, folder / "record.csv")
    made = ("-o", folder / "better.json", "--html", folder / "report.html")
    (folder / "improved.json").write_text(printed("improve", folder / "record.csv", *made, "--json"))
    return folder


def test_improve_writes_a_model_that_predicts_better(tired: Path, tmp_path: Path) -> None:
    found = json.loads((tired / "improved.json").read_text())
    assert [step["added"] for step in found["steps"]][:2] == [None, "fatigue"]
    assert (tired / "report.html").stat().st_size > 1000
    printed("fit", tired / "record.csv", "-o", tmp_path / "base.json")

    def rms_nm(model: Path) -> float:
        out = tmp_path / f"{model.stem}.csv"
        printed("predict", model, tired / "record.csv", "-o", out)
        with out.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
        assert list(rows[0]) == ["time_s", "torque_nm", "predicted_torque_nm"]
        gap = [float(row["torque_nm"]) - float(row["predicted_torque_nm"]) for row in rows]
        return float(np.sqrt(np.mean(np.square(gap))))

    assert rms_nm(tired / "better.json") < 0.5 * rms_nm(tmp_path / "base.json")


def test_the_verbs_mean_the_same_by_a_structure_and_give_one_verdict(tired: Path, tmp_path: Path) -> None:
    data, held, page, figures = tired / "record.csv", tired / "better.json", tmp_path / "s.html", tmp_path / "figures"
    improved = json.loads((tired / "improved.json").read_text())
    added = [step["added"] for step in improved["steps"][1:]]
    fitted = json.loads(held.read_text())
    assert [effect["id"] for effect in fitted["effects"]] == added and "fatigue" in added
    own = json.loads(printed("diagnose", data, "--model", held, "--json"))
    further = json.loads(printed("improve", data, "--model", held, "--json"))
    for verb, said in (("improve", improved), ("diagnose", own), ("improve", further)):
        assert unmet(verb, said) == []
    for verdict in (own, further):
        assert [name.partition(":")[0] for name in verdict["structure"]] == added
        assert verdict["verdict"] == "nothing_missing"
    assert not {row["effect"] for rows in own["candidates"] for row in rows} & set(added)
    assert own["base"]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    assert further["steps"][0]["rms_nm"] == pytest.approx(fitted["fit"]["rms_nm"], rel=0.02)
    told = json.loads(printed("explain", data, "--html", page, "--figures", figures, "--json"))
    assert [step["added"] for step in told["improvement"]["steps"][1:]] == told["diagnosis"]["add"] == added
    assert told["left"]["conclusion"] == own["conclusion"] and unmet("explain", told) == []
    assert all(place_words(place) in page.read_text() for place in told["places"]), "the same in words and numbers"
    kinds = {".svg": b"<svg", ".pdf": b"%PDF", ".png": b"\x89PNG"}
    names = {f"{name}{kind}" for name in ("story-torque", "story-place", "falling") for kind in kinds}
    assert {path.name for path in figures.iterdir()} == names
    assert all(path.read_bytes().startswith(kinds[path.suffix]) for path in figures.iterdir())
