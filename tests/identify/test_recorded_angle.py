"""A sealed recording's angles: brought to the torque's times, doubted where missing, refused where impossible."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.errors import BadRecord
from stimrig.identify.records.record import Record
from tests.identify.test_felt import seal


def angle_of(time_s: np.ndarray) -> np.ndarray:
    return 1.0 + 0.4 * np.sin(time_s)


def sealed(path: Path, kept: slice | np.ndarray = np.s_[:], spoil: str = "") -> Record:
    """A recording with angles at 200/s, of which only some are kept; read back."""
    seal(path)
    with h5py.File(path, "a") as file:
        at_s = np.arange(0.0013, file["/torque/time_s"][-1], 1 / 200)[kept]
        angle, velocity = angle_of(at_s), 0.4 * np.cos(at_s)
        if spoil == "nan":
            angle[7] = np.nan
        elif spoil == "backwards":
            at_s[7] = at_s[5]
        elif spoil == "short":
            angle = angle[:-1]
        file["/angle/time_s"], file["/angle/angle_rad"], file["/angle/velocity_rad_s"] = at_s, angle, velocity
        if spoil == "incomplete":
            del file["/angle/velocity_rad_s"]
    return identify.read(path)


def test_angles_are_brought_to_the_times_of_the_torque(tmp_path: Path):
    record = sealed(tmp_path / "a.h5")
    assert record.angle_rad is not None and record.velocity_rad_s is not None
    assert np.max(np.abs(record.angle_rad - angle_of(record.time_s))[5:-5]) < 1e-4
    assert np.max(np.abs(record.velocity_rad_s - 0.4 * np.cos(record.time_s))[5:-5]) < 1e-4
    plain = tmp_path / "p.h5"
    seal(plain)
    without = identify.read(plain)
    assert without.angle_rad is None and without.velocity_rad_s is None and without.notes == ()
    assert np.array_equal(_doubted(record), _doubted(without))


def _doubted(record: Record) -> np.ndarray:
    return np.zeros(record.time_s.size, bool) if record.doubted is None else record.doubted.astype(bool)


def test_rows_in_a_long_gap_are_doubted_and_in_a_short_one_not(tmp_path: Path):
    whole = _doubted(sealed(tmp_path / "w.h5"))
    kept = np.delete(np.arange(40 * 200), [*range(200, 208), *range(400, 430)])  # 45 ms and 155 ms, and the end
    record = sealed(tmp_path / "a.h5", kept)
    assert 40.5 < record.time_s[-1] < 80, "more than half must have an angle, and the end none"
    added_s = record.time_s[_doubted(record) & ~whole]
    gap_s, end_s = added_s[added_s < 5.0], added_s[added_s > 5.0]
    assert gap_s[0] > 399 / 200 and gap_s[-1] < 430 / 200 + 0.0014
    assert len(gap_s) == pytest.approx(400 * 0.155, abs=2)
    assert end_s[0] == pytest.approx(7999 / 200 + 0.0513, abs=0.003) and end_s[-1] == record.time_s[-1]


def test_a_sensor_that_failed_gives_no_angle_and_doubts_nothing(tmp_path: Path):
    whole = sealed(tmp_path / "w.h5")
    record = sealed(tmp_path / "a.h5", np.s_[:300])
    assert record.time_s[-1] > 4.0, "the rest of the record must be longer"
    assert record.angle_rad is None and record.velocity_rad_s is None
    assert np.array_equal(_doubted(record), _doubted(whole))
    assert record.notes[0].startswith("no angle: the angle sensor gave none in ")
    empty = sealed(tmp_path / "e.h5", np.s_[:0])
    assert empty.angle_rad is None and "100%" in empty.notes[0]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        ("nan", "angle_rad nan is no measurement"),
        ("backwards", "time runs backwards"),
        ("short", "differ in number"),
        ("incomplete", "incomplete recording"),
    ],
)
def test_impossible_angles_are_one_line(tmp_path: Path, spoil: str, says: str):
    with pytest.raises(BadRecord, match=says) as error:
        sealed(tmp_path / "a.h5", spoil=spoil)
    assert "/angle" in str(error.value) and "\n" not in str(error.value)
