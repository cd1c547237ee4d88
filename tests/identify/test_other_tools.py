"""Recordings of other tools: read right, and what was assumed is said; or refused in one line whose mend then works."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify import read
from stimrig.identify.errors import BadRecord
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from tests.harness.muscle import FINE_HZ
from tests.harness.patients import Patient, make_record, protocol

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
    "quotes within cells, and cells of two lines": (
        table(
            [[*row, '5" left' if k % 2 else '"one\ntwo, ""3"""'] for k, row in enumerate(cells())], (*HEADER, "note")
        ),
        "",
    ),
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


def saved(folder: Path, content: str | bytes, name: str = "ugly.csv") -> Path:
    path = folder / name
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


# ---- what is found, resampled or asked for ------------------------------------------------------------------------

RATE_HZ = 100
WIDTHS_US = np.linspace(0.0, 300.0, 31)


@cache
def measured() -> Record:
    record = make_record(Patient(), np.random.default_rng(5), rate_hz=RATE_HZ, noise_nm=0.05)[0]
    return replace(record, torque_nm=np.round(record.torque_nm, 4), pulse_width_us=np.round(record.pulse_width_us, 1))


@cache
def expected() -> identify.Model:
    return identify.fit(measured())


def names_of(record: Record) -> list[str]:
    return [record.segment_names[index] for index in record.segment]


def rows(record: Record, *, segment: bool = True) -> list[list[str]]:
    columns = [
        [f"{t:.7g}" for t in record.time_s],
        [f"{w:.9g}" for w in record.pulse_width_us],
        [f"{y:.9g}" for y in record.torque_nm],
    ]
    if segment:
        columns.append(names_of(record))
    return [list(row) for row in zip(*columns, strict=True)]


def test_stamps_of_a_host_that_comes_late_are_made_even(tmp_path: Path) -> None:
    cells = rows(measured())
    late_s = np.random.default_rng(2).uniform(0.0, 0.006, measured().time_s.size)
    for row, time_s in zip(cells, measured().time_s + late_s, strict=True):
        row[0] = f"{time_s:.6f}"
    record = read(saved(tmp_path, table(cells)))
    (note,) = record.notes
    assert "jitter by up to" in note and "suits the torque better" in note
    same(identify.fit(record), expected())


def same(model: identify.Model, other: identify.Model, tolerance: float = 1e-4) -> None:
    assert model.fit["fit_percent"] == pytest.approx(other.fit["fit_percent"], abs=100 * tolerance)
    assert model.linear.time_constant_s == pytest.approx(other.linear.time_constant_s, rel=tolerance)
    curve = other.recruitment(WIDTHS_US)
    assert np.max(np.abs(model.recruitment(WIDTHS_US) - curve)) < tolerance * np.ptp(curve)


def test_plain_files_have_nothing_to_say(tmp_path: Path) -> None:
    record = read(saved(tmp_path, table(rows(measured()))))
    assert record.notes == () and record.source.name == "ugly.csv" and len(record.source.sha256) == 64


def test_segments_are_found_and_none_is_held_out(tmp_path: Path) -> None:
    record = read(saved(tmp_path, table(rows(measured(), segment=False), HEADER[:3])))
    assert not record.held_out.any()
    true, found = np.array(names_of(measured())), np.array(names_of(record))
    for name in ("rest", "prbs", "ramp"):
        assert np.mean(found[true == name] == name) > 0.9, name
    assert set(found[true == "validate"]) <= {"multilevel", "rest"}
    (note,) = record.notes
    assert note.startswith("no segment column: found from the pulse widths: rest 0 to 1 s, prbs 1 to")
    assert "none is held out" in note
    same(identify.fit(record), identify.fit(Record.from_arrays(record.time_s, record.pulse_width_us, record.torque_nm)))


def test_a_width_that_never_becomes_zero(tmp_path: Path) -> None:
    """All widths 20 µs higher, of a muscle that answers 20 µs later: the same model, moved."""
    lifted = replace(measured(), pulse_width_us=measured().pulse_width_us + 20.0)
    named = saved(tmp_path, table(rows(lifted)), "named.csv")
    record = read(saved(tmp_path, table(rows(lifted, segment=False), HEADER[:3])))
    assert record.notes[1:] == read(named).notes == ("the lowest width, 20 µs, is taken as rest",)
    assert {"rest", "prbs", "ramp"} <= set(record.segment_names)
    model, plain = (
        identify.fit(record),
        identify.fit(Record.from_arrays(*(measured().time_s, measured().pulse_width_us, measured().torque_nm))),
    )
    assert model.linear.time_constant_s == pytest.approx(plain.linear.time_constant_s, rel=2e-3)
    curve = plain.recruitment(WIDTHS_US)
    assert np.max(np.abs(model.recruitment(WIDTHS_US + 20.0) - curve)) < 0.01 * np.ptp(curve)
    old = identify.fit(record, method="ramp-deconvolution")
    assert [one.valid_for["pulse_width_us"][0] for one in (model, old, plain)] == [20.0, 20.0, 0.0]


def test_rows_without_a_number_and_lost_rows_are_gaps(tmp_path: Path) -> None:
    cells = rows(measured())
    lost = [77, 1500, *range(2000, 2030)]
    for index, sign in zip(lost, ("NaN", "#NV", "n.a.", "", *["n/a"] * 28), strict=True):
        cells[index][2] = sign
    record = read(saved(tmp_path, table([row for index, row in enumerate(cells) if index != 3000])))
    kept = np.setdiff1d(np.arange(measured().time_s.size), [*lost, 3000])
    assert np.array_equal(record.torque_nm, measured().torque_nm[kept])
    assert record.time_s == pytest.approx(measured().time_s[kept], abs=1e-6)
    holes, gaps = record.notes
    assert holes == "32 rows are left out for want of a number (first at line 79, column torque_nm)"
    assert gaps == ("samples are missing at 4 places (first at line 80, column time_s; longest 0.31 s): left as gaps")
    same(identify.fit(record), expected(), 5e-3)


def test_uneven_samples_are_resampled_and_the_pulses_stay_in_place(tmp_path: Path) -> None:
    """A muscle sampled at uneven times of its own."""
    rng, patient = np.random.default_rng(11), Patient(time_constant_s=0.2, damping=0.8)
    widths, _ = protocol(rng)
    fine_nm = patient.torque(widths, FINE_HZ)
    at = np.cumsum(rng.integers(40, 121, fine_nm.size // 80))
    at = at[at < fine_nm.size - 1]
    torque_nm = fine_nm[at] + 0.03 * rng.standard_normal(at.size)
    time_s, width_us = at / FINE_HZ, widths[at * 40 // FINE_HZ]
    cells = [[f"{t:.6f}", f"{w:.4f}", f"{y:.5f}"] for t, w, y in zip(time_s, width_us, torque_nm, strict=True)]
    record = read(saved(tmp_path, table(cells, HEADER[:3])))
    assert np.ptp(np.diff(record.time_s)) < 1e-9
    assert record.notes[0].startswith("uneven time stamps (steps of 5 to 15 ms): resampled to ")
    assert record.notes[0].endswith("noise and error figures come out too small")
    assert record.sample_rate_hz == pytest.approx(100, rel=0.02)
    model = identify.fit(record)
    assert model.linear.time_constant_s == pytest.approx(0.2, rel=0.01)
    assert model.linear.delay_s == pytest.approx(0.0, abs=1e-3)
    assert np.max(np.abs(model.recruitment(WIDTHS_US) - patient.recruitment(WIDTHS_US))) < 0.02 * patient.gain


def test_times_rounded_more_coarsely_than_the_samples(tmp_path: Path) -> None:
    record = make_record(Patient(), np.random.default_rng(5), rate_hz=1600, noise_nm=0.05)[0]
    cells = rows(record)
    for row, time_s in zip(cells, record.time_s, strict=True):
        row[0] = f"{time_s:.3f}"
    found = read(saved(tmp_path, table(cells)))
    assert found.time_s == pytest.approx(record.time_s, abs=5e-4)
    assert found.notes == ("times are written to 1 ms only: samples are taken as even, at 1600 Hz",)


HEAD = "time_s,pulse_width_us,torque_nm"


@pytest.mark.parametrize(
    ("header", "given", "says"),
    [
        ("Time,PW,Torque", (), "line 1: column 'Time' is taken for time_s, but its unit is not said. "
         r"Give --map time_s=Time:s \(or ms, µs, ns, d\)\.$"),
        ("time_s,PW [V],torque_nm", (), r"'PW \[V\]' is taken for pulse_width_us, but its unit 'V' is not known"),
        ("time_s,pulse_width_us,Kraft", (), r"no column torque_nm\. Say which it is, for instance "
         "--map torque_nm=NAME:Nm; it has: time_s, pulse_width_us, Kraft"),
        ("time_s,pulse_width_us,Torque (N)", (), "Torque is asked for: multiply by the lever arm"),
        ("time_s,pulse_width_us,Torque [Nm],Moment [Nm]", (),
         r"torque_nm may be 'Torque \[Nm\]' or 'Moment \[Nm\]'. Say which, for instance --map torque_nm=Torque \[Nm\]"),
        (HEAD, ("torque=Moment",), "--map: no column is called 'torque'"),
        (HEAD, ("torque_nm=Moment:Nm",), "no column 'Moment:Nm' for torque_nm. It has: time_s, pulse_width_us"),
        (HEAD, ("torque_nm=a", "torque_nm=b"), "--map: torque_nm is given twice"),
        (HEAD, ("torque_nm=torque_nm:furlong",), "its unit 'furlong' is not known. Give --map torque_nm=torque_nm:Nm"),
        (HEAD, ("torque_nm=pulse_width_us:Nm",), "is asked for twice"),
        ("0.0,0,0.1", (), r"no header\. Say which column is which: --map time_s=#1:s"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_asked_for_in_one_line(tmp_path: Path, header: str, given: tuple, says: str) -> None:
    path = tmp_path / "data.csv"
    body = [",".join([f"{k / 40:.3f}", "100", "0.5", "1"][: header.count(",") + 1]) for k in range(400)]
    path.write_text("\n".join([header, *body]))
    with pytest.raises(BadRecord, match=says) as caught:
        read(path, map=given)
    assert "\n" not in str(caught.value)


ALL = cells()
EITHER = r"line \d+, column \w+: .*without signs between thousands"
"""A number that may be two is refused by its cell."""
WORKBOOK = "line 1: an .*Excel workbook.*Save the sheet as CSV text"
REFUSED: dict[str, tuple[str | bytes, str]] = {
    "points between thousands": (table(cells(comma(1, 1e3, "."), comma(1), comma(4)), MS, ";"), EITHER),
    "blanks between thousands": (table(cells(comma(1, 1e3, " "), comma(1), comma(4)), MS, ";"), EITHER),
    "hard blanks between thousands": (table(cells(comma(1, 1e3, "\xa0"), comma(1), comma(4)), MS, ";"), EITHER),
    "apostrophes between thousands": (table(cells(point(1, 1e3, "'")), MS), EITHER),
    "commas that may be either": (table(cells(point(0, 1e3, ",")), MS, ";"), EITHER),
    "quoted decimal commas": (table([[f'"{cell}"' for cell in row] for row in COMMAS]), EITHER),
    "points between some thousands": (
        table([[f"{10 * k}", "9", f"{991 + k % 5 * 5:,}".replace(",", ".")] for k in range(99)],
              (*MS[:2], "torque_mnm"), ";"),
        r"line 4, column torque_nm: 1\.001 among whole",
    ),
    "packed with gzip": (gzip.compress(table(ALL).encode()), "line 1: packed with gzip.*gunzip"),
    "a new workbook": (b"PK\x03\x04" + bytes(400), WORKBOOK),
    "an old workbook": (b"\xd0\xcf\x11\xe0\xa1\xb1" + bytes(400), WORKBOOK),
    "a clock": (
        table([[f"20:56:{row[0]}", *row[1:]] for row in ALL]),
        "line 2, column time_s: '20:56:0.0000' is no number. Times of a calendar or of a clock are not read",
    ),
    "two pulse rates": (
        table([[*row, str(25 + k // 300)] for k, row in enumerate(ALL)], (*HEADER, "pulse_rate_hz")),
        "pulse_rate_hz: different pulse rates",
    ),
    "a name against its unit": (
        table([["s", "us", "mNm", ""], *ALL], ("Time (s)", "PW (us)", "Torque (Nm)", "segment")),
        "says 'Nm', the row below it 'mNm'",
    ),
    "widths where they change": (
        table([[row[0], "" if k % 4 else row[1], *row[2:]] for k, row in enumerate(ALL)]), "Fill the width down",
    ),
    "widths at the pulses": (
        table([[f"{k / 200:.3f}", "0" if k % 5 else ALL[k // 20][1], "1", "prbs"] for k in range(1500)]),
        "only in the samples of the pulses. Hold each width",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_may_be_two_things_is_refused_with_a_way_out(tmp_path: Path, what: str) -> None:
    content, says = REFUSED[what]
    with pytest.raises(BadRecord, match=f"ugly.csv.*{says}") as refused:
        read(saved(tmp_path, content))
    assert "\n" not in str(refused.value)


UNSAID = {
    "a pulse rate in a column": (table([[*row, "25"] for row in ALL], (*HEADER, "pulse_rate_hz")), ()),
    "a pulse rate under another name, 0 at rest": (
        table([[*row, "25" if float(row[1]) else "0"] for row in ALL], (*HEADER, "Stim frequency")), (),
    ),
    "days": (
        table([[f"{46158.5 + at / 86400:.12f}", *row[1:]] for at, row in zip(TIME_S, ALL, strict=True)]),
        ("time_s=time_s:d",),
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", UNSAID)
def test_pulse_rates_and_days_are_read(tmp_path: Path, what: str) -> None:
    content, given = UNSAID[what]
    record = read(saved(tmp_path, content), map=given)
    np.testing.assert_allclose(record.time_s - record.time_s[0], TIME_S, atol=2e-6)
    assert record.pulse_rate_hz == (25.0 if "rate" in what else 40.0)


def test_a_unit_that_contradicts_the_header_is_said(tmp_path: Path) -> None:
    header = ("time_s", "pulse_width_us", "Torque [mNm]", "segment")
    record = read(saved(tmp_path, table(rows(measured()), header)), map={"torque_nm": "Torque:Nm"})
    assert record.notes == ("torque_nm is taken in Nm as --map says; its name says mNm",)
    assert np.array_equal(record.torque_nm, measured().torque_nm)


def test_angles_in_degrees_and_columns_without_a_unit_passed_over(tmp_path: Path) -> None:
    cells = [[*row[:3], "90", "180", "7"] for row in rows(measured())]
    record = read(saved(tmp_path, table(cells, (*HEADER[:3], "Angle [°]", "Velocity (deg/s)", "Position"))))
    assert record.angle_rad is not None and record.velocity_rad_s is not None
    assert record.angle_rad[0] == pytest.approx(np.pi / 2) and record.velocity_rad_s[0] == pytest.approx(np.pi)


@pytest.mark.parametrize("header", [("angle_rad",), ("angle_rad", "segment")], ids=["other tool's", "our own columns"])
def test_degrees_under_the_name_of_radians_are_refused(tmp_path: Path, header: tuple[str, ...]) -> None:
    all_rows = rows(measured())
    swept = [f"{60 + 40 * np.sin(0.01 * number):.3f}" for number in range(len(all_rows))]
    cells = [[*row[:3], angle, *row[3:][: len(header) - 1]] for row, angle in zip(all_rows, swept, strict=True)]
    path = saved(tmp_path, table(cells, (*HEADER[:3], *header)))
    with pytest.raises(BadRecord, match=r"column angle_rad: .* is no measurement.*angle_rad=angle_rad:deg"):
        read(path)
    record = read(path, map={"angle_rad": "angle_rad:deg"})
    assert record.angle_rad is not None and np.degrees(np.ptp(record.angle_rad)) == pytest.approx(80, abs=0.1)


def test_a_table_without_numbers_is_refused_in_one_line(tmp_path: Path) -> None:
    path = saved(tmp_path, table([("d", "e", "f")] * 200, ("a", "b", "c")))
    with pytest.raises(BadRecord, match="no numbers follow"):
        read(path, map=["time_s=#1:s", "pulse_width_us=#2", "torque_nm=#3:Nm"])
