"""Recordings of other tools: what is missing is found, resampled or asked for, and what was assumed is said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.records.record import Record
from tests.harness.muscle import FINE_HZ
from tests.harness.patients import Patient, make_record, protocol

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
    """Cells of a record with decimal points."""
    columns = [
        [f"{t:.7g}" for t in record.time_s],
        [f"{w:.9g}" for w in record.pulse_width_us],
        [f"{y:.9g}" for y in record.torque_nm],
    ]
    if segment:
        columns.append(names_of(record))
    return [list(row) for row in zip(*columns, strict=True)]


OURS = ("time_s", "pulse_width_us", "torque_nm", "segment")


def saved(folder: Path, header: Sequence[str], cells: Sequence[Sequence[str]], name: str = "data.csv") -> Path:
    path = folder / name
    path.write_text("\n".join(",".join(row) for row in (header, *cells)) + "\n")
    return path


def test_stamps_of_a_host_that_comes_late_are_made_even(tmp_path: Path) -> None:
    cells = rows(measured())
    late_s = np.random.default_rng(2).uniform(0.0, 0.006, measured().time_s.size)
    for row, time_s in zip(cells, measured().time_s + late_s, strict=True):
        row[0] = f"{time_s:.6f}"
    record = identify.read(saved(tmp_path, OURS, cells))
    (note,) = record.notes
    assert "jitter by up to" in note and "suits the torque better" in note
    same(identify.fit(record), expected())


def same(model: identify.Model, other: identify.Model, tolerance: float = 1e-4) -> None:
    assert model.fit["fit_percent"] == pytest.approx(other.fit["fit_percent"], abs=100 * tolerance)
    assert model.linear.time_constant_s == pytest.approx(other.linear.time_constant_s, rel=tolerance)
    curve = other.recruitment(WIDTHS_US)
    assert np.max(np.abs(model.recruitment(WIDTHS_US) - curve)) < tolerance * np.ptp(curve)


def test_plain_files_have_nothing_to_say(tmp_path: Path) -> None:
    assert identify.read(saved(tmp_path, OURS, rows(measured()))).notes == ()


def test_segments_are_found_and_none_is_held_out(tmp_path: Path) -> None:
    record = identify.read(saved(tmp_path, OURS[:3], rows(measured(), segment=False)))
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
    named = saved(tmp_path, OURS, rows(lifted), "named.csv")
    record = identify.read(saved(tmp_path, OURS[:3], rows(lifted, segment=False)))
    assert record.notes[1:] == identify.read(named).notes == ("the lowest width, 20 µs, is taken as rest",)
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
    record = identify.read(saved(tmp_path, OURS, [row for index, row in enumerate(cells) if index != 3000]))
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
    record = identify.read(saved(tmp_path, OURS[:3], cells))
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
    found = identify.read(saved(tmp_path, OURS, cells))
    assert found.time_s == pytest.approx(record.time_s, abs=5e-4)
    assert found.notes == ("times are written to 1 ms only: samples are taken as even, at 1600 Hz",)


HEAD = "time_s,pulse_width_us,torque_nm"


@pytest.mark.parametrize(
    ("header", "given", "says"),
    [
        ("Time,PW,Torque", (), "line 1: column 'Time' is taken for time_s, but its unit is not said. "
         r"Give --map time_s=Time:s \(or ms, µs\)\.$"),
        ("time_s,PW [V],torque_nm", (), r"'PW \[V\]' is taken for pulse_width_us, but its unit 'V' is not known"),
        ("time_s,pulse_width_us,Kraft", (), r"no column torque_nm\. Say which it is, for instance "
         "--map torque_nm=NAME:Nm; it has: time_s, pulse_width_us, Kraft"),
        ("time_s,pulse_width_us,Torque (N)", (), "Torque is asked for: multiply by the lever arm"),
        ("time_s,pulse_width_us,Torque [Nm],Moment [Nm]", (),
         r"torque_nm may be 'Torque \[Nm\]' or 'Moment \[Nm\]'. Say which, for instance --map torque_nm=Torque \[Nm\]"),
        (HEAD, ("torque=Moment",), "--map: no column is called 'torque'"),
        (HEAD, ("torque_nm",), "--map: 'torque_nm' has no '='"),
        (HEAD, ("torque_nm=Moment:Nm",), "no column 'Moment:Nm' for torque_nm. It has: time_s, pulse_width_us"),
        (HEAD, ("torque_nm=a", "torque_nm=b"), "--map: torque_nm is given twice"),
        (HEAD, ("torque_nm=torque_nm:furlong",), "its unit 'furlong' is not known. Give --map torque_nm=torque_nm:Nm"),
        (HEAD, ("torque_nm= ",), "no name for torque_nm"),
        (HEAD, ("torque_nm=pulse_width_us:Nm",), "is asked for twice"),
        ("0.0,0,0.1", (), r"no header\. Say which column is which: --map time_s=#1:s"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_asked_for_in_one_line(tmp_path: Path, header: str, given: tuple, says: str) -> None:
    path = tmp_path / "data.csv"
    body = [",".join([f"{k / 40:.3f}", "100", "0.5", "1"][: header.count(",") + 1]) for k in range(400)]
    path.write_text("\n".join([header, *body]))
    with pytest.raises(identify.BadRecord, match=says) as caught:
        identify.read(path, map=given)
    assert "\n" not in str(caught.value)


def test_a_unit_that_contradicts_the_header_is_said(tmp_path: Path) -> None:
    header = ("time_s", "pulse_width_us", "Torque [mNm]", "segment")
    record = identify.read(saved(tmp_path, header, rows(measured())), map={"torque_nm": "Torque:Nm"})
    assert record.notes == ("torque_nm is taken in Nm as --map says; its name says mNm",)
    assert np.array_equal(record.torque_nm, measured().torque_nm)


def test_angles_in_degrees_and_columns_without_a_unit_passed_over(tmp_path: Path) -> None:
    cells = [[*row[:3], "90", "180", "7"] for row in rows(measured())]
    record = identify.read(saved(tmp_path, (*OURS[:3], "Angle [°]", "Velocity (deg/s)", "Position"), cells))
    assert record.angle_rad is not None and record.velocity_rad_s is not None
    assert record.angle_rad[0] == pytest.approx(np.pi / 2) and record.velocity_rad_s[0] == pytest.approx(np.pi)


@pytest.mark.parametrize("header", [("angle_rad",), ("angle_rad", "segment")], ids=["other tool's", "our own columns"])
def test_degrees_under_the_name_of_radians_are_refused(tmp_path: Path, header: tuple[str, ...]) -> None:
    all_rows = rows(measured())
    swept = [f"{60 + 40 * np.sin(0.01 * number):.3f}" for number in range(len(all_rows))]
    cells = [[*row[:3], angle, *row[3:][: len(header) - 1]] for row, angle in zip(all_rows, swept, strict=True)]
    path = saved(tmp_path, (*OURS[:3], *header), cells)
    with pytest.raises(identify.BadRecord, match=r"column angle_rad: .* is no measurement.*angle_rad=angle_rad:deg"):
        identify.read(path)
    record = identify.read(path, map={"angle_rad": "angle_rad:deg"})
    assert record.angle_rad is not None and np.degrees(np.ptp(record.angle_rad)) == pytest.approx(80, abs=0.1)


def test_a_table_without_numbers_is_refused_in_one_line(tmp_path: Path) -> None:
    path = saved(tmp_path, ("a", "b", "c"), [("d", "e", "f")] * 200)
    with pytest.raises(identify.BadRecord, match="no numbers follow") as refused:
        identify.read(path, map=["time_s=#1:s", "pulse_width_us=#2", "torque_nm=#3:Nm"])
    assert "\n" not in str(refused.value)
