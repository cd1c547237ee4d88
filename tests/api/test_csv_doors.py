"""Every table that leaves: what begins like a formula is text, a number stays one, and we read back what it was."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stimrig import identify
from stimrig.api import record_files
from stimrig.api.cli.files import inversion_table
from stimrig.identify.records import cells
from stimrig.identify.records.join import write_joined
from stimrig.identify.records.record import Record, Source

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
