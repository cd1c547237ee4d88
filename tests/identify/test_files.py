"""Reading: CSV and sealed recordings, and every way in which they can be wrong."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.records import read
from tests.identify.test_felt import seal

HEADER = "time_s,pulse_width_us,torque_nm,segment"
ROWS = [f"{i / 40:.4f},{100 * (i % 3)},{0.1 * i:.3f},prbs" for i in range(20)]


LATE_HEADER = HEADER + ",late_s,doubted"


def write(folder: Path, *lines: str, header: str = HEADER) -> Path:
    path = folder / "data.csv"
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def late(late_s: object, doubted: object) -> list[str]:
    return [f"{row},{late_s},{doubted}" for row in ROWS]


def changed(line: int, column: int, value: str) -> list[str]:
    """ROWS with one cell changed; `line` counts from 1 as an editor does, the header being 1."""
    rows = [row.split(",") for row in ROWS]
    rows[line - 2][column] = value
    return [",".join(row) for row in rows]


def test_rounded_times_become_even(tmp_path):
    rows = [f"{i / 1600:.4f},{100 * (i // 40 % 2)},0.5,prbs" for i in range(4000)]
    record = read(write(tmp_path, *rows))
    assert record.sample_rate_hz == pytest.approx(1600, rel=1e-4)
    assert np.ptp(np.diff(record.time_s)) < 1e-9


@pytest.mark.parametrize(
    ("lines", "header", "says"),
    [
        (ROWS, "time_s,pulse_width_us,segment", r"line 1: no column torque_nm\. Say which it is, for instance --map"),
        (ROWS, "time_s,pulse_width_us,torque_nm", r"line 2: 4 cells under a header of 3\. Name every column"),
        (ROWS, HEADER + ",torque_nm", "torque_nm is there twice"),
        (changed(7, 2, "strong"), HEADER, r"line 7, column torque_nm: 'strong' is no number"),
        (changed(7, 2, "nan")[:9], HEADER, r"line 7, column torque_nm: no number\. At most 10 % of the rows"),
        (changed(9, 0, "inf"), HEADER, r"line 9, column time_s: inf is no measurement"),
        (changed(5, 1, "-3"), HEADER, r"line 5, column pulse_width_us: -3 µs is negative"),
        (changed(12, 0, "0.1"), HEADER, r"line 12, column time_s: time runs backwards"),
        ([*ROWS[:9], *ROWS[8:]], HEADER, r"line 11, column time_s: time stands still .* once each"),
        (changed(4, 3, " "), HEADER, r"line 4, column segment: empty"),
        (changed(5, 2, "1,5"), HEADER, r"line 5: 5 cells under a header of 4.*decimal commas"),
        ([*ROWS[:10], "0.25,1,2"], HEADER, r"line 12, column segment: only 3 cells"),
        (late("soon", 0), LATE_HEADER, r"line 2, column late_s: 'soon' is no number\. Write"),
        (late(12, 0), LATE_HEADER, r"line 2, column late_s: 12 is no measurement"),
        (late("nan", 0), LATE_HEADER, r"line 2, column late_s: no number"),
        (late(0, 0.5), LATE_HEADER, r"line 2, column doubted: 0\.5 is no measurement\. 1 is"),
        ([], HEADER, "no row under the header"),
        (ROWS[:3], HEADER, "only 3 samples"),
        ([f"{i},0,0,rest" for i in range(20)], HEADER, "sampled at 1 Hz"),
    ],
)
def test_bad_csv_names_line_and_column(tmp_path, lines, header, says):
    with pytest.raises(identify.BadRecord, match=says) as caught:
        read(write(tmp_path, *lines, header=header))
    assert "data.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path):
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "zero.csv").write_bytes(HEADER.encode() + b"\n0,0,0,r\0st\n")
    (tmp_path / "half.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 100)
    for name, says in (
        ("absent.csv", "no such file"),
        ("", "a directory"),
        ("empty.csv", "line 1: empty"),
        ("zero.csv", "line 2: not text"),
        ("half.h5", "half-written"),
    ):
        with pytest.raises(identify.BadRecord, match=says):
            read(tmp_path / name)
    with pytest.raises(identify.BadRecord, match="1 to 200 Hz"):
        read(write(tmp_path, *ROWS), pulse_rate_hz=float("nan"))


def test_reads_a_sealed_recording(tmp_path):
    true = seal(tmp_path / "r.h5", rate_hz=1600, late=False)
    record = read(tmp_path / "r.h5")
    assert record.pulse_rate_hz == 40
    assert set(record.segment_names) == {"rest", "prbs", "ramp", "validate"}
    assert np.mean(record.pulse_width_us == np.repeat(true["widths"], 40)[: record.time_s.size]) > 0.97
    model = identify.fit(record)
    assert model.linear.time_constant_s == pytest.approx(0.15, rel=5e-3)
    # All pulses were late together, and so was the torque: no delay between them.
    assert model.linear.delay_s == pytest.approx(0.0, abs=1.5e-3)
    assert model.data["recording_id"] == record.source.recording_id == "r"


def test_held_out_rows_in_another_case_or_with_blanks_are_held_out_and_told(tmp_path):
    seal(tmp_path / "r.h5")
    expected = read(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "a") as file:
        names = [name.decode().replace("validate", "Validate ") for name in file["/segments/name"][()]]
        del file["/segments/name"]
        file["/segments/name"] = names
    row = "{:.3f},{:.0f},1,{}".format
    half = [row(k / 100, k % 90, "rest" if k < 100 else (" VALIDATE", "validate")[k % 2]) for k in range(200)]
    (tmp_path / "r.csv").write_text("time_s,pulse_width_us,torque_nm,segment\n" + "\n".join(half))
    sealed, table = read(tmp_path / "r.h5"), read(tmp_path / "r.csv")
    assert np.array_equal(sealed.held_out, expected.held_out) and sealed.segment_names == expected.segment_names
    assert sealed.notes == ("segment 'Validate ' is taken as validate",) and expected.notes == ()
    assert table.segment_names == ("rest", "validate") and table.held_out.sum() == 100
    assert table.notes == ("segment 'VALIDATE' is taken as validate",)
    assert sealed.take(sealed.held_out).notes == sealed.notes
    given = identify.Record.from_arrays(*(np.arange(3.0),) * 3, segment=["rest", "Validate", "validate "])
    assert given.held_out.tolist() == [False, True, True] and len(given.segment_names) == 2


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda file: file.attrs.update(format="other"), "no stimrig recording"),
        (lambda file: file.attrs.update(format_version=9), "format version 9"),
        (lambda file: file.attrs.update(format_version=2), "format version 2"),
        (lambda file: file.__delitem__("/pulses/status"), "incomplete recording"),
        (lambda file: file.__delitem__("/torque"), "incomplete recording"),
        (lambda file: file["/torque/torque_nm"].__setitem__(5000, np.nan), "torque is not finite"),
        (lambda file: file["/torque/time_s"].__setitem__(5000, -1.0), "time runs backwards|not finite"),
    ],
)
def test_spoiled_recordings_are_refused(tmp_path, spoil, says):
    seal(tmp_path / "r.h5")
    with h5py.File(tmp_path / "r.h5", "a") as file:
        spoil(file)
    with pytest.raises(identify.BadRecord, match=says):
        read(tmp_path / "r.h5")
