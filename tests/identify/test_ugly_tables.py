"""Tables as spreadsheets and other tools leave them: read right, or refused in one line whose mend then works."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stimrig.identify import read
from stimrig.identify.errors import BadRecord
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record

HEADER = ("time_s", "pulse_width_us", "torque_nm", "segment")
MS = ("time_ms", *HEADER[1:])
SIZE = 400
RNG = np.random.default_rng(5)
TIME_S = np.arange(SIZE) * 0.025
WIDTH_US = np.repeat(RNG.choice([0.0, 150.0, 250.0, 350.0], SIZE // 4), 4)
TORQUE_NM = np.round(np.convolve(WIDTH_US, 0.012 * 0.9 ** np.arange(60))[:SIZE] + 0.01 * RNG.standard_normal(SIZE), 4)
SEGMENT = np.where(np.arange(SIZE) < 300, "prbs", "validate")
Write = Callable[[float], str]


def point(digits: int, times: float = 1.0, thousands: str = "", decimal: str = ".") -> Write:
    """How a number is written."""
    signs = str.maketrans({",": thousands, ".": decimal})
    return lambda value: f"{value * times:,.{digits}f}".translate(signs)


def comma(digits: int, times: float = 1.0, thousands: str = "") -> Write:
    return point(digits, times, thousands, ",")


FOUR, WHOLE = point(4), point(0)


def cells(time: Write = FOUR, width: Write = WHOLE, torque: Write = FOUR) -> list[list[str]]:
    values = zip(TIME_S, WIDTH_US, TORQUE_NM, SEGMENT, strict=True)
    return [[time(a), width(b), torque(c), str(d)] for a, b, c, d in values]


def table(rows: list[list[str]], header: tuple[str, ...] = HEADER, between: str = ",", end: str = "\n") -> str:
    return end.join(between.join(row) for row in [header, *rows]) + end


COMMAS = cells(comma(4), comma(1), comma(4))
READ: dict[str, tuple[str | bytes, str]] = {
    "semicolons, decimal commas": (table(COMMAS, between=";"), "decimal commas"),
    "byte order mark": ("\ufeff" + table(cells()), ""),
    "UTF-16": (table(cells()).encode("utf-16"), ""),
    "a row of units": (table([["[s]", "[µs]", "[Nm]", ""], *cells()]), ""),
    "a separator at each row's end": (table([[*row, ""] for row in cells()]), ""),
    "no segments": (table([row[:3] for row in cells()], HEADER[:3]), ""),
    "Excel's sep=": ("sep=;\r\n" + table(COMMAS, between=";", end="\r\n"), "header in line 2"),
    "line ends of an old Mac": ("sep=;\r" + table(COMMAS, between=";", end="\r"), "header in line 2"),
    "widths in named seconds": (
        table(cells(width=point(6, 1e-6)), ("time_s", "pulse width [s]", *HEADER[2:])),
        "pulse_width_us is 'pulse width [s]' in s",
    ),
    "time in named milliseconds": (table(cells(point(1, 1e3)), MS), "time_s is 'time_ms' in ms"),
    "quoted numbers": (table([[f'"{cell}"' for cell in row] for row in cells()]), ""),
    "comments before and between": ("# a tool\n" + table([*cells()[:50], ["# remark"], *cells()[50:]]), "in line 2"),
    "Latin-1": (
        table(cells(), ("Zeit [s]", "Pulsweite [µs]", "Drehmoment [Nm]", "segment")).encode("latin-1"),
        "Windows-1252",
    ),
    "thousands of blank lines": (table(cells()) + "\n" * 5000, ""),
    "thousands of empty rows": (table(cells()) + ",,,\n" * 5000, ""),
    "other case and blanks": (table(cells(), ("Time (s)", "PULSE WIDTH [us]", " Torque  (N·m) ", "Segment")), "in us"),
    "lines before the header, tabs, time in ms": (
        "Device\tBench 3\nSampling rate\t100\n\n"
        + table(
            cells(point(1, 1e3), torque=point(1, 1e3)), ("Zeit [ms]", "pw [us]", "Drehmoment (mNm)", "Segment"), "\t"
        ),
        "tabs between cells, header in line 4; time_s is 'Zeit [ms]' in ms",
    ),
    "aligned with blanks": (
        "# by hand\n" + table([[cell.rjust(9) for cell in row] for row in cells()], between=" "),
        "blanks between cells, header in line 2",
    ),
    "times of the calendar": (
        table([[f"{1.7e9 + at:.4f}", *row[1:]] for at, row in zip(TIME_S, cells(), strict=True)]),
        "time is counted from the first sample, at 1700000000.000 s",
    ),
    "torque in Ncm": (table(cells(torque=point(2, 100)), ("time_s", "pulse_width_us", "torque_ncm", "segment")), "ncm"),
}
"""What is read, and what its notes tell of what was taken for granted."""


def saved(folder: Path, content: str | bytes) -> Path:
    path = folder / "ugly.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check(record: Record) -> None:
    np.testing.assert_allclose(record.time_s, TIME_S, atol=1e-7)  # as fine as times of the calendar are
    np.testing.assert_allclose(record.pulse_width_us, WIDTH_US)
    np.testing.assert_allclose(record.torque_nm, TORQUE_NM, atol=1e-9)


@pytest.mark.parametrize("what", READ)
def test_it_is_read_right_and_what_was_assumed_is_told(tmp_path: Path, what: str) -> None:
    content, told = READ[what]
    record = read(saved(tmp_path, content))
    check(record)
    assert told in "; ".join(record.source.notes)
    if what != "no segments":
        assert np.array_equal(np.array(record.segment_names)[record.segment], SEGMENT)


def test_names_and_units_of_a_map(tmp_path: Path) -> None:
    rows = [[str(k), *row] for k, row in enumerate(cells(point(0, 1e6), point(3, 1e-3), point(2, 100)))]
    given = ["time_s=T:us", "pulse_width_us=PW: left:ms", "torque_nm=M:N·cm", "segment=what"]
    record = read(saved(tmp_path, table(rows, ("no", "T", "PW: left", "M", "what"), ";")), map=given)
    check(record)
    assert np.array_equal(np.array(record.segment_names)[record.segment], SEGMENT)


def test_a_table_without_a_header_is_read_by_the_numbers_of_its_columns(tmp_path: Path) -> None:
    given = {"time_s": "#1:s", "pulse_width_us": "#2:µs", "torque_nm": "#3:Nm", "segment": "#4"}
    record = read(saved(tmp_path, "\n".join("|".join(row) for row in cells())), map=given)
    check(record)
    assert "bars between cells, no header" in record.notes


def test_joined_records_keep_what_was_said_of_their_parts(tmp_path: Path) -> None:
    record = read(saved(tmp_path, table(COMMAS, between=";")))
    joined = join([record, record.with_torque(record.torque_nm[::-1].copy())], [0.0, 100.0])
    assert joined.notes == ("ugly.csv: semicolons between cells, decimal commas",)


ASKED = {
    "widths in seconds": (cells(width=point(6, 1e-6)), HEADER, "pulse_width_us=pulse_width_us:s"),
    "widths in milliseconds": (cells(width=point(3, 1e-3)), HEADER, "pulse_width_us=pulse_width_us:ms"),
    "time in milliseconds": (cells(point(1, 1e3)), HEADER, "time_s=time_s:ms"),
    "a time without a unit": (cells(), ("t", *HEADER[1:]), "time_s=t:s"),
}


@pytest.mark.parametrize("what", ASKED)
def test_a_unit_is_asked_for_and_the_answer_works(tmp_path: Path, what: str) -> None:
    rows, header, mend = ASKED[what]
    path = saved(tmp_path, table(rows, header))
    with pytest.raises(BadRecord, match=r"ugly.csv, line \d+") as refused:
        read(path)
    # Two units may be meant where only the size of the numbers speaks: the line offers one, and names the other.
    assert mend.rpartition(":")[0] in str(refused.value) and "\n" not in str(refused.value)
    check(read(path, map=[mend]))


NUMBERS = {
    "points between thousands": table(cells(comma(1, 1e3, "."), comma(1), comma(4)), MS, ";"),
    "blanks between thousands": table(cells(comma(1, 1e3, " "), comma(1), comma(4)), MS, ";"),
    "hard blanks between thousands": table(cells(comma(1, 1e3, "\xa0"), comma(1), comma(4)), MS, ";"),
    "apostrophes between thousands": table(cells(point(1, 1e3, "'")), MS),
    "commas that may be either": table(cells(point(0, 1e3, ",")), MS, ";"),
    "quoted decimal commas": table([[f'"{cell}"' for cell in row] for row in COMMAS]),
}


@pytest.mark.parametrize("what", NUMBERS)
def test_a_number_that_may_be_two_is_refused_by_its_cell(tmp_path: Path, what: str) -> None:
    with pytest.raises(BadRecord, match=r"csv, line \d+, column \w+: .*without signs between thousands") as refused:
        read(saved(tmp_path, NUMBERS[what]))
    assert "\n" not in str(refused.value)


def test_a_time_that_stands_still_is_refused_and_its_row_can_be_taken_out(tmp_path: Path) -> None:
    rows = cells()
    with pytest.raises(BadRecord, match=r"line 62, column time_s: time stands still .* once each"):
        read(saved(tmp_path, table([*rows[:60], rows[59], *rows[60:]])))
    check(read(saved(tmp_path, table(rows))))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (gzip.compress(table(cells()).encode()), "packed with gzip.*gunzip"),
        (b"PK\x03\x04" + bytes(400), "an .*Excel workbook.*Save the sheet as CSV text"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1" + bytes(400), "an .*Excel workbook.*Save the sheet as CSV text"),
    ],
)
def test_a_packed_table_and_a_workbook_are_called_so(tmp_path: Path, content: bytes, says: str) -> None:
    with pytest.raises(BadRecord, match=rf"ugly.csv, line 1: {says}"):
        read(saved(tmp_path, content))
