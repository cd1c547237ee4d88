"""The verbs of the command line take several recordings as the parts of one; what does not go together is named."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stimrig import identify
from stimrig.api.cli import main
from stimrig.identify.records.join import write_joined
from tests.api.test_cli import run
from tests.api.test_worker import made_up_csv
from tests.identify import hidden_muscles

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """One record, and another one with an angle."""
    folder = tmp_path_factory.mktemp("several")
    plain = made_up_csv(folder / "plain.csv")
    head, *rows = (row.split(",") for row in plain.read_text().splitlines())
    moved = folder / "moved.csv"
    more = [f"{t},{w},{0.97 * float(nm):.6f},{s},{0.8 + 0.001 * k:.4f},0.04" for k, (t, w, nm, s) in enumerate(rows)]
    moved.write_text("\n".join([",".join([*head, "angle_rad", "velocity_rad_s"]), *more]))
    return [plain, moved]


def test_a_fit_of_two_is_of_both(parts: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "MODEL.json"
    code, out, err = run(capsys, "fit", *parts, "-o", model, "--json")
    assert code == 0, err
    assert "plain.csv: no angle_rad, so it is left out of the joined record" in err
    assert json.loads(out)["data"]["recording_id"] == "plain.csv + moved.csv"
    code, out, err = run(capsys, "compare", model, *parts, "--html", tmp_path / "report.html")
    assert code == 0 and "plain.csv and " in out, err
    assert "plain.csv, moved.csv" in (tmp_path / "report.html").read_text("utf-8")
    code, out, err = run(capsys, "diagnose", *parts, "--model", model, "--json")
    assert code == 0 and json.loads(out)["verdict"], err


def test_the_one_without_an_angle_is_named(parts: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(capsys, "fit", *parts, "--effects", "torque_angle")
    assert (code, out) == (2, "")
    assert "plain.csv: it has no angle_rad" in err and len(err.strip().splitlines()) == 1


def test_a_file_twice_or_none_is_refused(parts: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "fit", parts[0], parts[0])
    assert code == 2 and "named twice" in err
    assert run(capsys, "fit")[0] == 2


def test_a_copy_or_a_link_is_no_second_recording(
    parts: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, link = tmp_path / "copy.csv", tmp_path / "link.csv"
    copy.write_bytes(parts[0].read_bytes())
    link.symlink_to(parts[0])
    for again in (copy, link, parts[0].parent / ".." / parts[0].parent.name / parts[0].name):
        code, _, err = run(capsys, "fit", parts[0], again)
        assert code == 2 and "measured in another" in err and again.name in err, err


def test_what_cannot_be_joined_names_its_file(
    parts: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.csv"
    short.write_text("\n".join(parts[0].read_text().splitlines()[:6]))
    code, _, err = run(capsys, "fit", parts[0], short)
    assert code == 2 and "short.csv" in err and len(err.strip().splitlines()) == 1, err


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The model of a first session, and the record of a second one without the effect."""
    folder = tmp_path_factory.mktemp("carry")
    model, data = folder / "MODEL.json", folder / "second.csv"
    earlier = identify.fit(
        hidden_muscles.record("electromechanical_delay", seed=7), effects=["electromechanical_delay"]
    )
    model.write_text(earlier.to_json())
    write_joined(hidden_muscles.record("", seed=8), data)
    return model, data


def test_words_and_json_say_what_is_no_longer_needed(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = files
    out = tmp_path / "new.json"
    assert main.run(["fit", str(data), "--carry", str(model), "-o", str(out)]) == 0
    words = capsys.readouterr().out
    assert "offered: the plain structure" in words and "no longer needed: electromechanical_delay." in words
    assert main.run(["fit", str(data), "--carry", str(model), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["effects"] == [] and found["extra"]["carried"]["no_longer_needed"] == ["electromechanical_delay"]
    assert json.loads(out.read_text())["extra"]["carried"]["offered"] == "plain"


def test_options_of_another_structure_are_one_line(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    model, data = files
    assert main.run(["fit", str(data), "--carry", str(model), "--effects", "fatigue"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "Leave out --method, --effects and --fit-on." in err
