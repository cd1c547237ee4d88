"""`stimrig export`: one CSV, MAT or Parquet file for each record, which reads back as what was recorded."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat

import stimrig
from stimrig import identify
from stimrig.api import record_files
from stimrig.api.cli import main
from stimrig.api.cli.files import inversion_table
from stimrig.api.export.folder import ERRORS, RECORDS
from stimrig.api.export.record_file import WRITERS
from stimrig.errors import BadRequest
from stimrig.identify.records import cells
from stimrig.identify.records.join import write_joined
from stimrig.identify.records.record import Record, Source
from tests.api.test_schemas import unmet
from tests.harness.cohort_records import Session, broken, write

CSV = "time_s,pulse_width_us,torque_nm,segment\n" + "".join(
    f"{k / 100!r},{100.0 if k % 200 < 100 else 0.0},{math.sin(k / 30)!r},{'prbs' if k < 600 else 'validate'}\n"
    for k in [*range(300), *range(310, 900)]  # ten samples are lost
)
DAYS = (b"2026-01-05", b"20260105", b"2026-01-12", b"20260112", b"session-0", b"Monday")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sessions of two people and a table with a gap."""
    folder = tmp_path_factory.mktemp("data")
    for number, (who, day) in enumerate([("P-1", "2026-01-05"), ("P-1", "2026-01-12"), ("=P2ü", "2026-01-05")]):
        write(folder / f"session-{number}.h5", Session(who, day, seed=number, kind="Monday 2026-01-05"))
    (folder / "table.csv").write_text(CSV)
    return folder


def export(*words: object) -> int:
    return main.run(["export", *map(str, words)])


def listed(folder: Path, name: str = RECORDS) -> list[dict[str, str]]:
    with (folder / name).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("format", WRITERS)
def test_each_record_reads_back(format: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(data, "-o", tmp_path / "out", "--format", format, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["records"], told["errors"]) == (4, 0) and unmet("export", told) == []
    rows = listed(tmp_path / "out")
    originals = {hashlib.sha256(path.read_bytes()).hexdigest(): identify.read(path) for path in data.iterdir()}
    assert {row["sha256"] for row in rows} == originals.keys()
    assert sorted(row["participant"] for row in rows) == ["", "'=P2ü", "P-1", "P-1"], "no formula"
    for row in rows:
        same(identify.read(tmp_path / "out" / row["file"]), originals[row["sha256"]])
        assert originals[row["sha256"]].pulse_rate_hz == float(row["pulse_rate_hz"])


def same(again: identify.Record, record: identify.Record) -> None:
    assert again.samples().keys() == record.samples().keys() and again.pulse_rate_hz == record.pulse_rate_hz
    for name, column in record.samples().items():
        assert np.allclose(again.samples()[name], column, rtol=0, atol=1e-6 if name == "time_s" else 1e-12), name
    assert again.segment_names == record.segment_names and np.array_equal(again.segment, record.segment)
    assert np.array_equal(again.held_out, record.held_out)


@pytest.mark.parametrize("format", WRITERS)
def test_every_column_is_saved_and_read(format: str, tmp_path: Path) -> None:
    time_s = np.arange(1000) / 100
    record = identify.Record.from_arrays(
        time_s, np.where(time_s % 2 < 1, 200.0, 0.0), np.sin(time_s), ["prbs"] * 500 + ["=validate"] * 500,
        angle_rad=np.cos(time_s), velocity_rad_s=np.sin(time_s), late_s=np.full(1000, 0.001),
        doubted=np.arange(1000) % 100 == 7, pulse_rate_hz=50.0,
    )  # fmt: skip
    path = stimrig.save(record, tmp_path / f"record.{format}")
    same(identify.read(path), record)
    if format == "parquet":
        schema = pytest.importorskip("pyarrow.parquet", reason="pip install pyarrow").read_schema(path)
        units = {field.name: field.metadata[b"unit"].decode() for field in schema if field.name != "segment"}
        assert units == {
            "time_s": "s", "pulse_width_us": "µs", "torque_nm": "Nm", "angle_rad": "rad", "velocity_rad_s": "rad/s",
            "late_s": "s", "doubted": "1",
        }  # fmt: skip
    if format == "mat":
        found: Any = loadmat(path)
        assert found["torque_nm"].shape == (1000, 1) and found["segment"][0].strip() == "prbs"
        assert b"202" not in path.read_bytes()[:116], "no date"


def test_a_joined_record_keeps_its_parts_in_csv_only(data: Path, tmp_path: Path) -> None:
    joined = stimrig.join([data / "session-0.h5", data / "session-1.h5"])
    stimrig.save(joined, tmp_path / "joined.csv")
    assert export(tmp_path / "joined.csv", "-o", tmp_path / "out", "--no-dates") == 0
    (row,) = listed(tmp_path / "out")
    assert len(identify.read(tmp_path / "out" / row["file"]).parts) == 2
    for format in ("mat", "parquet"):
        with pytest.raises(BadRequest, match="CSV"):
            stimrig.save(joined, tmp_path / f"joined.{format}")


@pytest.mark.parametrize("format", WRITERS)
def test_days_that_are_hidden_stand_nowhere(format: str, data: Path, tmp_path: Path) -> None:
    good = sorted(data.glob("session*"))
    if format == "csv":
        good.append(stimrig.save(stimrig.join(good[:2]), tmp_path / "2026-01-05 session-0.csv"))
    assert export(*good, "-o", tmp_path / "out", "--format", format, "--no-dates") == 0
    for path in (tmp_path / "out").iterdir():
        content = path.read_bytes() + path.name.encode()
        if path.suffix == ".parquet":
            from pyarrow import parquet

            content += str(parquet.read_table(path).to_pylist()).encode()
        assert not [day for day in DAYS if day in content], path.name
    assert export(*good, "-o", tmp_path / "dated", "--format", format) == 0
    assert all(row["begun_utc"] for row in listed(tmp_path / "dated") if row["participant"])


def test_one_that_cannot_be_read_is_a_line_and_the_others_are_done(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shell script goes on after an exit code 0: it would believe that all was exported."""
    (tmp_path / "data").mkdir()
    broken(tmp_path / "data", data / "session-0.h5")
    (tmp_path / "data" / "copy.h5").write_bytes((data / "session-0.h5").read_bytes())
    (tmp_path / "data" / "map.csv").write_text(CSV.replace("torque_nm", "Kraft"))
    words = (data, tmp_path / "data", "-o", tmp_path / "out", "--map", "torque_nm=Kraft:Nm", "--json")
    assert export(*words) == 1
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert (told["records"], told["copies"]) == (4, 1), "the table with another tool's name for the torque among them"
    assert err.count("\n") == 1 and f"{told['errors']} of {told['errors'] + 4} records gave no result" in err
    rows = listed(tmp_path / "out", ERRORS)
    assert {Path(row["address"]).name for row in rows} >= {"half.h5", "words.csv", "nul.mat"}
    assert all(row["reason"] and "Traceback" not in row["reason"] for row in rows)
    assert all("record." not in row["reason"].split(":")[0] for row in rows), "messages name the file as it is called"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("data", "--output"),
        ("data -o new --format bids", "csv, mat, parquet"),
        ("data -o new --select nonsense==1", "nonsense"),
        ("data -o new --map nonsense", "--map"),
        ("data -o data", "not empty"),
        ("nowhere -o new", "nowhere"),
    ],
)
def test_wrong_options_are_one_line(
    options: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "photo.jpg").write_bytes(b"x")
    assert export(*options.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and named in said
    assert not (tmp_path / "new").exists()


# ---- Every table that leaves: what begins like a formula is text, a number stays one, and we read back what it was.


HOSTILE = ("=HYPERLINK(1)", "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\uff1d1", "a;=1", "'=1")


@given(st.text("=+-@\t\r\n'\uff1d;, a"))
def test_a_text_is_told_as_text_and_read_back(text: str) -> None:
    assert cells.as_written(cells.cell_text(text)) == text
    assert not runs(cells.cell_text(text))


@pytest.mark.parametrize("text", [*HOSTILE[:5], "\t=1", "\r=1"])
def test_a_cell_that_begins_like_a_formula_is_text(text: str) -> None:
    assert cells.cell(text) == f"'{text}"
    assert cells.cell("a;" + text.strip()) == f"a;'{text.strip()}", "a German spreadsheet separates at ;"


def test_a_number_stays_a_number() -> None:
    assert [cells.cell(value) for value in (-1.5, -2, 1e-7, None, "no-formula=")] == [
        "-1.5", "-2", "1e-07", "", "no-formula="
    ]  # fmt: skip


def test_a_joined_record(tmp_path: Path) -> None:
    record = named()
    write_joined(record, tmp_path / "joined.csv")
    assert texts_of(tmp_path / "joined.csv", "segment", "name") >= {cells.cell_text(text) for text in HOSTILE}
    back = identify.read(tmp_path / "joined.csv")
    assert back.segment_names == record.segment_names
    assert np.array_equal(back.torque_nm, record.torque_nm), "negative ones, too"


def test_a_recording(tmp_path: Path) -> None:
    """Somebody's own file goes in with formulas; what is handed out has none, and is read as the same segments."""
    rows = (f"{k / 100:.2f},{k % 7},{-k / 1000},{HOSTILE[k // 40]}\n" for k in range(40 * len(HOSTILE)))
    (tmp_path / "in.csv").write_text("time_s,pulse_width_us,torque_nm,segment\n" + "".join(rows))
    record_files.plain_csv(str(tmp_path / "in.csv"), lambda *_: None, str(tmp_path / "out.csv"))
    texts_of(tmp_path / "out.csv", "segment")
    given, back = identify.read(tmp_path / "in.csv"), identify.read(tmp_path / "out.csv")
    assert back.segment_names == given.segment_names
    assert np.array_equal(back.torque_nm, given.torque_nm)


COLUMNS = ("pulse_width_us", "reference_torque_nm", "predicted_torque_nm")


def test_numbers_only() -> None:
    widths = {"pulse_rate_hz": 40.0, **{name: [-0.5, 1.0] for name in COLUMNS}}
    assert all(is_number(cell) for row in inversion_table(widths).split()[1:] for cell in row.split(","))


def named() -> Record:
    """A record of two parts whose segments, file and id are hostile."""
    count = 40 * len(HOSTILE)
    time_s = np.arange(count) / 100
    segment = np.repeat(HOSTILE, 40)

    def one(number: int) -> Record:
        source = Source(HOSTILE[number], f"@{number}", f"{number}" * 64)
        width_us = np.where(np.arange(count) % 50 < 25, 100.0 + number, 0.0)
        return Record.from_arrays(time_s, width_us, -time_s - number, segment, source=source)

    from stimrig.identify.records.join import join

    joined = [join([one(a), one(b)], [0.0, 100.0]) for a, b in ((0, 1), (2, 3), (4, 5))]
    return join([*joined, one(6)], [0.0, 500.0, 1000.0, 1500.0])


def texts_of(path: Path, *columns: str) -> set[str]:
    """The cells of some columns; no text in the whole table may run."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert not [cell for row in rows for pair in row.items() for cell in pair if runs(cell) and not is_number(cell)]
    return {row[column] for row in rows for column in columns}


def runs(cell: str) -> bool:
    """Whether a spreadsheet computes a cell, also one that separates at a semicolon."""
    parts = (part.lstrip(" ") for part in re.split("[;,]", cell))
    return any(part.startswith(tuple("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")) for part in parts)


def is_number(cell: str) -> bool:
    try:
        float(cell.replace("n/a", "nan"))
    except ValueError:
        return False
    return True
