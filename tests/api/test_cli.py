"""The verbs: what they print, refuse and leave behind, with which exit code; what `doctor` finds; Ctrl-C."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import httpx
import numpy as np
import pytest

from bench.muscles import hidden_records
from stimrig import identify
from stimrig.api.cli import main
from stimrig.api.cli.commands import doctor
from stimrig.api.cli.commands.doctor import Finding, examine
from stimrig.api.progress_bar import progress_bar
from stimrig.api.settings import Settings
from stimrig.identify.healing import place_words
from tests.api.conftest import Service, soon
from tests.api.test_jobs import made_up_csv
from tests.api.test_schemas import unmet
from tests.harness import few_effects
from tests.harness.processes import READY_TIMEOUT_S

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
    names = {"plain": "csv", "moved": "csv", "short": "csv", "bad": "csv", "rate": "json", "own": "py"}
    files = {name: folder / f"{name}.{suffix}" for name, suffix in names.items()}
    made_up_csv(files["plain"])
    head, *rows = (row.split(",") for row in files["plain"].read_text().splitlines())
    more = [f"{t},{w},{0.97 * float(nm):.6f},{s},{0.8 + 0.001 * k:.4f},0.04" for k, (t, w, nm, s) in enumerate(rows)]
    files["moved"].write_text("\n".join([",".join([*head, "angle_rad", "velocity_rad_s"]), *more]))
    files["short"].write_text("\n".join(files["plain"].read_text().splitlines()[:6]))
    files["bad"].write_text("time_s,pulse_width_us,torque_nm,segment\n0.0,0,0.1,prbs\n0.025,abc,0.1,prbs\n")
    files["own"].touch()
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
        ("fit {record} -o /nowhere/at/all/M.json", "/nowhere/at/all/M.json: give a file in a folder"),
        ("fit {record} -o {record}", "record.csv: it would replace a file of this command"),
        ("fit {record} --carry {model} -o {model}", "MODEL.json: it would replace"),
        ("improve {record} -o x --html {record}", "record.csv: it would replace"),
        ("improve {record} -o x --html x", "x: it would replace"),
        ("compare {model} {record} --html {model}", "MODEL.json: it would replace"),
        ("predict {model} {record} -o {record}", "record.csv: it would replace"),
        ("invert {model} {record} -o {model}", "MODEL.json: it would replace"),
        ("explain {record} --own {record}", "record.csv: give a name that ends in .py"),
        ("explain {record} --own {own}", "own.py: it exists already: move it or give another name"),
        ("explain {record} --own /nowhere/x.py", "/nowhere/x.py: give a file in a folder"),
        ("explain {record} --figures {record}", "record.csv/story-torque.svg: give a file in a folder"),
        ("explain {record} --html x/free-free_width_by_rise.pdf --figures x", "would replace"),
        ("predict nowhere.json {record} -o x.csv", "nowhere.json"),
        ("predict {record} {record} -o x.csv", "record.csv"),
        ("predict {model} {record} -o /nowhere/x.csv", "/nowhere/x.csv: "),
        ("predict {model} {record} -o {model}/x.csv", "MODEL.json/x.csv: give a file in a folder"),
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


def test_a_verb_does_not_wait_for_the_libraries_of_others() -> None:
    """Nor does that of cohorts load without the extra that it names."""
    code = "import sys; from stimrig.api.cli.main import build; build('diagnose'); build('cohort'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"sqlalchemy", "dask", "distributed", "pyarrow", "fsspec"} & set(done.stdout.split())


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


# ---- `stimrig doctor` says what is wrong and how to fix it -----------------------------------------------------------


RIG = """data_dir = "{folder}"
socket = "{folder}/rig.sock"
[stimulator]
device = "p24"
port = "{port}"
[load_cell]
device = "can_load_cell"
bus = {{ interface = "{interface}", channel = "{channel}" }}
"""


def rig_file(folder: Path, port: str = "/dev/null", interface: str = "slcan", channel: str = "/dev/null") -> Path:
    path = folder / "rig.toml"
    path.write_text(RIG.format(folder=folder, port=port, interface=interface, channel=channel))
    return path


def finding(name: str, **settings: object) -> Finding:
    check = getattr(doctor, f"check_{name.replace(' ', '_')}")
    return next(found for found in check(Settings(**settings)) if found.check == name)


def test_sound_machine_exits_0_and_one_json_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["doctor", "--data", str(tmp_path), "--rig", str(rig_file(tmp_path)), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    verdicts = {found["check"]: found["verdict"] for found in report["findings"]}
    assert verdicts["rig file"] == verdicts["stimulator"] == verdicts["load cell"] == "ok"
    assert set(verdicts) >= {"data folder", "disk", "priority", "database"}


def test_missing_devices_exit_1_with_the_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = rig_file(tmp_path, port=str(tmp_path / "not-there"), interface="socketcan", channel="can77")
    assert main.run(["doctor", "--data", str(tmp_path), "--rig", str(path)]) == 1
    out = capsys.readouterr().out
    assert "not-there is not there" in out and "plug it in" in out
    assert "there is no interface can77" in out and "stimrig-can@can77" in out


def test_wrong_key_of_the_rig_file_is_named(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    path.write_text(path.read_text().replace("port =", "prot ="))
    found = finding("rig file", rig_file=path, data_dir=tmp_path)
    assert found.verdict == "fails" and "stimulator.port" in found.says


def test_each_check_of_the_machine_finds_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Little room, a folder open to all, a check that breaks, no port."""
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: Mock(free=0.1e9))
    monkeypatch.setattr(doctor, "check_rights", Mock(side_effect=RuntimeError("no such thing")))
    for mode, fix in ((0o755, "chmod o-rwx"), (0o750, "")):
        tmp_path.chmod(mode)
        found = {one.check: one for one in examine(Settings(data_dir=tmp_path))}
        assert found["data folder"].fix.partition(" /")[0] == fix
    assert found["disk"].verdict == "fails" and "no such thing" in found["rights"].says
    assert doctor.examine_port("stimulator", Path(__file__)).verdict == "fails"


def test_rig_that_is_not_there_or_stands_still(service: Service, client: httpx.Client, tmp_path: Path) -> None:
    assert finding("rig", data_dir=tmp_path, rig_socket=tmp_path / "none.sock").verdict == "fails"
    assert finding("rig", data_dir=tmp_path, rig_socket=service.rig.path).verdict == "ok"
    client.post("/v1/stop")
    found = finding("rig", data_dir=tmp_path, rig_socket=service.rig.path)
    assert found.verdict == "fails" and "latched" in found.says and "re-arm" in found.fix


def test_tampered_trail_is_found(service: Service) -> None:
    assert finding("database", data_dir=service.data).verdict == "ok"
    service.sql("UPDATE audit SET who = 'nobody' WHERE seq = 1")
    assert finding("database", data_dir=service.data).verdict == "fails"


# ---- Ctrl-C ends long work: the process is gone, its copies too, and no file is half-written -------------------------


BUSY = """
import signal, sys, time
from stimrig import identify
from stimrig.api.cli import main

def hold(*_, **__):
    print("computing", file=sys.stderr, flush=True)
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            pass

identify.explain = hold
main.main(sys.argv[1:])
"""
"""As a library that calls us from its C code: the exception is dropped."""
SLOW = """
import sys, time

class Slow:
    def find_spec(name, *_):
        if name == "numpy":
            print("loading", file=sys.stderr, flush=True)
            time.sleep(600)

sys.meta_path.insert(0, Slow)
sys.argv = ["stimrig", "diagnose", sys.argv[1]]
from stimrig.__main__ import main
main()
"""


def interrupted(log: Path, said: str, *words: object) -> tuple[int, str]:
    """Begin a command, interrupt it once it has said something; its process group, and all that it said."""
    with log.open("wb") as file:
        process = subprocess.Popen([sys.executable, *map(str, words)], stdout=file, stderr=file, start_new_session=True)
    soon(lambda: said in log.read_text() or process.poll() is not None, READY_TIMEOUT_S)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=READY_TIMEOUT_S) == 130, log.read_text()
    return process.pid, log.read_text()


def test_ctrl_c_ends_a_verb_whatever_it_is_in(record: Path, tmp_path: Path) -> None:
    output = tmp_path / "out" / "MODEL.json"
    output.parent.mkdir()
    output.write_text("as it was")
    _, said = interrupted(tmp_path / "log", "computing", "-c", BUSY, "explain", record, "-o", output)
    assert "interrupted" in said and "Traceback" not in said
    assert output.read_text() == "as it was" and [path.name for path in output.parent.iterdir()] == ["MODEL.json"]


def test_ctrl_c_while_libraries_are_loaded_is_no_traceback(record: Path, tmp_path: Path) -> None:
    assert "Traceback" not in interrupted(tmp_path / "log", "loading", "-c", SLOW, record)[1]


def test_copies_of_a_search_end_with_it(record: Path, tmp_path: Path) -> None:
    watched = ("-X", "importtime", "-m", "stimrig", "explain", record)
    group, _ = interrupted(tmp_path / "log", "stimrig.identify.diagnosis.free", *watched)
    soon(lambda: all(_group(path) != group for path in Path("/proc").glob("[0-9]*")), READY_TIMEOUT_S)


def _group(process: Path) -> int:
    try:
        return int((process / "stat").read_text().rsplit(")", 1)[1].split()[2])
    except (OSError, IndexError):
        return 0
