"""Parquet files as records: columns by name, unit and `--map`; a hostile or damaged file is refused in one line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.records import bounds
from stimrig.identify.records import parquet as reader

pa = pytest.importorskip("pyarrow", reason="pip install pyarrow")
pq = pytest.importorskip("pyarrow.parquet", reason="pip install pyarrow")

N = 2000
TIME_S = np.arange(N) / 100
WIDTH_US = np.where(np.arange(N) % 200 < 100, 200.0, 0.0)
TORQUE_NM = np.sin(TIME_S)
SEGMENT = np.where(TIME_S < 10, "prbs", "validate")
OURS = {"time_s": TIME_S, "pulse_width_us": WIDTH_US, "torque_nm": TORQUE_NM, "segment": SEGMENT}


def written(folder: Path, columns: dict[str, Any], metadata: dict[str, str] | None = None, **options: Any) -> Path:
    table = pa.table(columns)
    pq.write_table(table.replace_schema_metadata(metadata), folder / "x.parquet", **options)
    return folder / "x.parquet"


def test_our_columns_are_read(tmp_path: Path) -> None:
    path = written(tmp_path, OURS, {"pulse_rate_hz": "50"}, row_group_size=300)
    record = identify.read(path)
    assert np.array_equal(record.torque_nm, TORQUE_NM) and np.array_equal(record.pulse_width_us, WIDTH_US)
    assert record.segment_names == ("prbs", "validate") and record.held_out.sum() == N // 2
    assert record.pulse_rate_hz == 50 and identify.read(path, 40.0).pulse_rate_hz == 40
    assert record.source.name == "x.parquet" and len(record.source.sha256) == 64 and record.notes == ()


def test_another_tools_table_is_read_by_names_units_and_map(tmp_path: Path) -> None:
    unit = pa.field("M", pa.float32(), metadata={"unit": "mNm"})
    milliseconds = np.arange(N) * 10
    arrays = [milliseconds, (TORQUE_NM * 1000).astype(np.float32), WIDTH_US.astype(np.int16)]
    schema = pa.schema([pa.field("Zeit [ms]", pa.int64()), unit, pa.field("a.pw", pa.int16())])
    pq.write_table(pa.table([pa.array(one) for one in arrays], schema=schema), tmp_path / "t.parquet")
    record = identify.read(tmp_path / "t.parquet", map=["torque_nm=M", "pulse_width_us=a.pw:us"])
    assert record.time_s == pytest.approx(TIME_S) and record.torque_nm == pytest.approx(TORQUE_NM, abs=1e-6)
    assert np.array_equal(record.pulse_width_us, WIDTH_US)
    assert any("mNm" in note for note in record.notes) and any("no segment column" in note for note in record.notes)


def test_timestamps_are_read(tmp_path: Path) -> None:
    stamps = pa.array((1_700_000_000_000 + 10 * np.arange(N)).tolist(), pa.timestamp("ms"))
    record = identify.read(written(tmp_path, OURS | {"time_s": stamps}))
    assert record.time_s == pytest.approx(TIME_S, abs=1e-6)


def cut(length: int) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[:length])


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[4:2000] = bytes(byte ^ 0xFF for byte in content[4:2000])
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"time_s": None}, "no column time_s"),
        ({"torque_nm": None, "Torque": TORQUE_NM}, "unit is not said"),
        ({"time_s": [str(one) for one in TIME_S]}, "no numbers"),
        ({"torque_nm": [[1.0]] * N}, "no numbers"),
        ({"torque_nm": np.full(N, np.inf)}, "no measurement"),
        ({"segment": pa.array([None] + ["prbs"] * (N - 1))}, "without a name"),
        ({"segment": ["a" * 200] * N}, "200 characters"),
        ({"time_s": np.zeros(N)}, "row"),
    ],
)
def test_what_is_no_record_is_refused(change: dict[str, Any], named: str, tmp_path: Path) -> None:
    columns = {name: column for name, column in (OURS | change).items() if column is not None}
    with pytest.raises(identify.BadRecord, match=named) as caught:
        identify.read(written(tmp_path, columns))
    assert "\n" not in str(caught.value) and "x.parquet" in str(caught.value) and len(str(caught.value)) < 600


@pytest.mark.parametrize("damage", [cut(3000), cut(9), flipped, cut(0)], ids=["cut", "head", "flipped", "empty"])
def test_a_damaged_file_is_refused(damage: Callable[[Path], None], tmp_path: Path) -> None:
    path = written(tmp_path, OURS)
    damage(path)
    with pytest.raises(identify.BadRecord, match="damaged"):
        identify.read(path)


def test_a_column_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    arrays = [pa.array(column) for column in (*OURS.values(), TORQUE_NM)]
    pq.write_table(pa.Table.from_arrays(arrays, [*OURS, "torque_nm"]), tmp_path / "x.parquet")
    for given in ({}, {"torque_nm": "#5:Nm"}):
        with pytest.raises(identify.BadRecord):
            identify.read(tmp_path / "x.parquet", map=given)


def test_what_is_packed_small_is_bounded_by_what_it_is_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Constant columns take next to nothing in a file."""
    path = written(tmp_path, OURS | {f"c{k}": np.zeros(N) for k in range(40)})
    monkeypatch.setattr(reader, "UNPACKED_BYTES", 40 * 8 * N)
    with pytest.raises(identify.BadRecord, match="44 columns"):
        identify.read(path)
    monkeypatch.setattr(reader, "UNPACKED_BYTES", 2**30)
    monkeypatch.setattr(reader, "LARGEST_ROWS", N - 1)
    with pytest.raises(identify.BadRecord, match="rows"):
        identify.read(path)


def test_a_long_text_that_repeats_is_held_once(tmp_path: Path) -> None:
    """As plain texts these are 20 GB."""
    names = pa.DictionaryArray.from_arrays(pa.array(np.zeros(200_000, np.int32)), ["a" * 100_000])
    rows = {name: np.resize(column, 200_000) for name, column in OURS.items() if name != "segment"}
    path = written(tmp_path, rows | {"time_s": np.arange(200_000) / 100, "segment": names})
    assert path.stat().st_size < bounds.LARGEST_FILE_BYTES
    with pytest.raises(identify.BadRecord, match="100000 characters"):
        identify.read(path)


def test_without_pyarrow_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, OURS)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(identify.BadRecord, match="pip install pyarrow"):
        identify.read(path)
