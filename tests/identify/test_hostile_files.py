"""Files as weapons: refused in one line that names the file, with no more memory than a record takes."""

from __future__ import annotations

import random
import tracemalloc
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from stimrig import identify
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records import bounds
from stimrig.identify.records.hdf5 import StrictFile
from tests.harness import hostile_shapes as shapes

pytestmark = pytest.mark.slow


def told(path: Path) -> str:
    """The line in which a file is refused; empty where it is taken."""
    try:
        identify.read(path)
    except identify.IdentifyError as error:
        assert "\n" not in str(error) and str(path) in str(error) and len(str(error)) < 400
        return str(error)
    return ""


def test_every_shape_of_recording_is_refused_in_one_line(tmp_path: Path) -> None:
    tried = 0
    for hostile in shapes.hdf5_shapes(tmp_path):
        path = tmp_path / "upload.h5"
        path.write_bytes(hostile.content)
        assert bool(told(path)) == hostile.refused, hostile.name
        tried += 1
    assert tried > 140


def test_a_virtual_dataset_over_another_files_bytes_is_not_followed(tmp_path: Path) -> None:
    """As it was found: the bytes came back as torque, and with them the administrator's token."""
    (tmp_path / "secret.txt").write_bytes(shapes.SECRET)
    path = tmp_path / "upload.h5"
    path.write_bytes(shapes.good(shapes.virtual_over_raw, tmp_path))
    with h5py.File(path) as file:
        assert bytes(file["torque/torque_nm"][:30].astype("u1")) == shapes.SECRET[:30], (
            "the attack works with plain h5py"
        )
    assert "not plainly in this file" in told(path)


def test_recordings_with_bytes_changed_or_cut_are_answered(tmp_path: Path) -> None:
    rng, path = random.Random(24), tmp_path / "upload.h5"
    lines = []
    for number in range(80):
        path.write_bytes(shapes.spoiled(rng, number).content)
        lines.append(told(path))
    assert any(lines) and not all(lines)


def test_a_list_of_texts_that_does_not_end_is_refused(tmp_path: Path) -> None:
    """libhdf5 never comes back from it."""
    content, path = bytearray(shapes.good()), tmp_path / "upload.h5"
    at = content.index(b"GCOL") + 40
    content[at : at + 4000] = bytes(4000)
    path.write_bytes(content)
    assert "unreadable or half-written" in told(path)


@pytest.mark.parametrize("hostile", list(shapes.csv_shapes()), ids=lambda hostile: hostile.name)
def test_every_shape_of_table_is_refused_in_one_line(tmp_path: Path, hostile: shapes.Hostile) -> None:
    path = tmp_path / "upload.csv"
    path.write_bytes(hostile.content[:500_000])
    assert bool(told(path)) == hostile.refused


@pytest.mark.parametrize("filling", [b"\n", b"1,", b'"a\n"', b"nan,nan,nan,prbs\n", b"0.0,0,0,prbs\n"])
def test_memory_follows_what_a_table_holds(tmp_path: Path, filling: bytes) -> None:
    path = tmp_path / "upload.csv"
    path.write_bytes(shapes.HEADER + filling * (100_000 // len(filling)))
    tracemalloc.start()
    try:
        assert told(path)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()


def test_more_lines_than_a_record_has_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "LARGEST_ROWS", 1000)
    path = tmp_path / "upload.csv"
    path.write_bytes(shapes.HEADER + b"\n" * 2000)
    assert "line 1001: more than 1000 lines" in told(path)
    monkeypatch.setattr(bounds, "LARGEST_FILE_BYTES", 1000)
    assert "more than" in told(path)


def test_plain_and_packed_datasets_read_as_h5py_reads_them(tmp_path: Path) -> None:
    values = np.random.default_rng(3).standard_normal(12_345)
    for libver in ("earliest", "latest"):
        path = tmp_path / f"{libver}.h5"
        with h5py.File(path, "w", libver=libver) as file:
            file["plain"] = values
            file["big-endian"] = values.astype(">f4")
            file["bytes"] = np.arange(200, dtype="u1")
            file.create_dataset("all", data=values, chunks=(1000,), compression="gzip", shuffle=True, fletcher32=True)
            file.create_dataset("odd", data=values.astype("i2"), chunks=(77,), fletcher32=True, maxshape=(None,))
            file.create_dataset("none", shape=(0,), dtype="f8")
            file.create_dataset("words", data=["rest", "Übung"], dtype=h5py.string_dtype())
            file["plain words"] = np.array([b"rest", b"prbs"])
            wanted = {name: file[name][:] for name in ("plain", "big-endian", "bytes", "all", "odd", "none")}
        strict = StrictFile(path.read_bytes(), "f")
        for name, expected in wanted.items():
            assert np.array_equal(strict.numbers(name), expected.astype(float)), (libver, name)
        assert strict.names("words") == ["rest", "Übung"] and strict.names("plain words") == ["rest", "prbs"]


def test_a_damaged_checksum_and_a_bomb_in_a_chunk_are_found(tmp_path: Path) -> None:
    path = tmp_path / "f.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("sum", data=np.arange(1000.0), chunks=(1000,), fletcher32=True)
        bomb = file.create_dataset("bomb", shape=(1000,), dtype="f8", chunks=(1000,), compression="gzip")
        bomb.id.write_direct_chunk((0,), zlib.compress(bytes(20_000_000)))
        place = file["sum"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 1
    strict = StrictFile(bytes(content), "f")
    for name, says in (("sum", "unreadable or half-written"), ("bomb", "larger than what it holds")):
        with pytest.raises(identify.BadRecord, match=says):
            strict.numbers(name)


@pytest.mark.parametrize("hostile", list(shapes.model_shapes()), ids=lambda hostile: hostile.name)
def test_every_shape_of_model_is_refused_in_one_line(hostile: shapes.Hostile) -> None:
    with pytest.raises(identify.BadModel) as caught:
        identify.Model.from_json(hostile.content)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[" * 33 + "]" * 33, "more than 32 brackets"),
        ('{"a": 1, "a": 2}', "'a' is there twice"),
        ('{"b": {"a": 1, "a": 1}}', "'a' is there twice"),
        ("NaN", "NaN is not a number"),
        ("[1e999]", "1e999 is too large"),
        ("1" * 5000, "a number with too many digits"),
        ('{"a": ', "not JSON"),
        (b"\xff", "not UTF-8"),
    ],
)
def test_strict_json(text: str | bytes, says: str) -> None:
    with pytest.raises(BadJson, match=says):
        parse(text)


def test_brackets_in_strings_are_no_depth() -> None:
    text = '{"a": "' + "[" * 500 + '\\"' + "{" * 500 + '"}'
    assert len(parse(text)["a"]) == 1001
    assert parse(b'\xef\xbb\xbf{"a": [1.5]}') == {"a": [1.5]}
