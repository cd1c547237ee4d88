"""MAT files in and out: written and read by scipy, an implementation apart; and files made to break a reader."""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from stimrig import identify
from stimrig.identify.records.mat import variables
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, make_record
from tests.identify.test_hostile_files import told

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def record() -> Record:
    return make_record(Patient(), np.random.default_rng(3), rate_hz=100, noise_nm=0.05)[0]


def columns(record: Record) -> dict[str, Any]:
    names = np.array(record.segment_names, object)[record.segment]
    return {
        "time_s": record.time_s,
        "pulse_width_us": record.pulse_width_us,
        "torque_nm": record.torque_nm,
        "segment": names,
    }


def saved(path: Path, content: dict[str, Any], **how: Any) -> Path:
    savemat(path, content, **how)
    return path


def ways(record: Record) -> dict[str, tuple[dict[str, Any], dict[str, str] | None, dict[str, Any]]]:
    plain = columns(record)
    with_more = plain | {
        "comment": "a Monday",
        "raw": np.ones((3, 4, 5)),
        "z": 1j,
        "many": np.full((2, 2), 1.0, object),
    }
    own = {"t": record.time_s * 1e3, "pw": record.pulse_width_us * 1e-6, "M": record.torque_nm * 1e3}
    rows = np.array(plain["segment"], "U")
    return {
        "variables": (plain, None, {}),
        "packed, in rows, beside others": (with_more, None, {"do_compression": True, "oned_as": "row"}),
        "a struct": ({"record": plain, "fs": 100.0}, None, {"do_compression": True}),
        "names and units of their own": (
            own | {"part": rows}, {"time_s": "t:ms", "pulse_width_us": "pw:s", "torque_nm": "M:mNm", "segment": "part"},
            {"do_compression": True},
        ),
        "own names in a struct": (
            {"d": own | {"part": rows}},
            {"time_s": "d.t:ms", "pulse_width_us": "pw:s", "torque_nm": "d.M:mNm", "segment": "d.part"}, {},
        ),
        "fields of any depth": (
            {"d": {"t": own["t"], "stim": {"pw": own["pw"]}}, "M": own["M"], "part": rows},
            {"time_s": "d.t:ms", "pulse_width_us": "d.stim.pw:s", "torque_nm": "M:mNm", "segment": "part"}, {},
        ),
    }  # fmt: skip


@pytest.mark.parametrize("way", range(6))
def test_the_same_data_give_the_same_record(tmp_path: Path, record: Record, way: int) -> None:
    content, given, how = list(ways(record).values())[way]
    found = identify.read(saved(tmp_path / "data.mat", content | {"pulse_rate_hz": 50.0}, **how), map=given)
    assert found.pulse_rate_hz == (40.0 if "a struct" in list(ways(record))[way] else 50.0)
    assert found.segment_names == record.segment_names and np.array_equal(found.segment, record.segment)
    for name in ("time_s", "pulse_width_us", "torque_nm"):
        assert getattr(found, name) == pytest.approx(getattr(record, name), rel=1e-12, abs=1e-9), name
    assert found.notes == () and len(found.source.sha256) == 64


def test_numbers_of_every_kind_are_read_as_scipy_reads_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    content: dict[str, Any] = {
        kind: rng.integers(0, 100, 50).astype(kind) for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4")
    }
    content |= {"f8": rng.standard_normal(50), "logical": rng.random(50) > 0.5, "one": 3.5, "none": np.zeros((0, 0))}
    for packed in (False, True):
        path = saved(tmp_path / "data.mat", content, do_compression=packed)
        found, theirs = variables(path.read_bytes(), "f"), loadmat(path)
        for name in content:
            assert np.array_equal(found[name].numbers(), np.ravel(theirs[name]).astype(float)), name


# ---- what cannot be taken ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"torque_nm": np.ones((40, 40))}, r"torque_nm: 40×40 numbers\. Give one row or column"),
        ({"torque_nm": np.ones(7)}, r"torque_nm: 7 numbers for 1600 samples\. Give one for each sample"),
        ({"torque_nm": np.ones(1600) * 1j}, r"torque_nm: complex numbers"),
        ({"torque_nm": "strong"}, r"torque_nm: no numbers\. Turn it into plain numbers"),
        ({"segment": np.array(["a", 3.0], object)}, r"segment: a cell array with something in it\. Give texts only"),
        ({"segment": np.array(["a", "b"], object)}, r"segment: 2 names for 1600 samples"),
        ({"segment": ""}, "segment: 0 names for 1600 samples"),
        ({"pulse_rate_hz": 4e4}, "pulse_rate_hz: 40000 pulses a second"),
    ],
)  # fmt: skip
def test_what_cannot_be_taken_is_one_line(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    size = 1600
    content: dict[str, Any] = {
        "time_s": np.arange(size) / 100, "pulse_width_us": 100.0 * (np.arange(size) // 50 % 2),
        "torque_nm": np.zeros(size),
    }  # fmt: skip
    content = {name: value for name, value in (content | change).items() if value is not None}
    with pytest.raises(identify.BadRecord, match=says):
        identify.read(saved(tmp_path / "data.mat", content))
    assert told(tmp_path / "data.mat")


def test_other_versions_are_refused_with_what_to_do(tmp_path: Path) -> None:
    old = saved(tmp_path / "old.mat", {"time_s": np.arange(9.0)}, format="4")
    assert "no MAT file of version 5 to 7. Save plain columns" in told(old)
    new = tmp_path / "new.mat"
    new.write_bytes(
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + bytes(384) + b"\x89HDF\r\n\x1a\n"
    )
    assert "a MAT file of version 7.3. Save plain columns" in told(new) and "'-v7'" in told(new)
    nothing = tmp_path / "nothing.mat"
    nothing.write_bytes(b"")
    assert told(nothing)


def matrix(kind: int, dims: tuple[int, ...], name: bytes, rest: bytes = b"") -> bytes:
    """A variable by hand, as declared and no more."""

    def element(tag: int, data: bytes) -> bytes:
        return struct.pack("<II", tag, len(data)) + data + bytes(-len(data) % 8)

    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack(f"<{len(dims)}i", *dims)) + element(1, name)
    return element(14, head + rest)


def names_of_fields(length: int, names: bytes) -> bytes:
    return struct.pack("<IIII", 5, 4, length, 0) + struct.pack("<II", 1, len(names)) + names


HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def packed(data: bytes) -> bytes:
    body = zlib.compress(data)
    return struct.pack("<II", 15, len(body)) + body


def weapons() -> dict[str, bytes]:
    """Files that declare, unpack to or hold what no record holds, each with a variable where the time should be."""
    huge = (2_000_000_000, 1)
    others = b"".join(
        matrix(6, (1, 1), name, struct.pack("<IId", 9, 8, 1.0)) for name in (b"pulse_width_us", b"torque_nm")
    )
    time = {
        "a terabyte of numbers": matrix(6, huge, b"time_s", struct.pack("<II", 9, 2**31)),
        "numbers that are not there": matrix(6, (1_000_000, 1), b"time_s", struct.pack("<IId", 9, 8, 1.0)),
        "a terabyte of cells": matrix(1, huge, b"time_s"),
        "a bomb": packed(matrix(6, (1_000_000, 1), b"time_s", struct.pack("<II", 9, 8_000_000) + bytes(30_000_000))),
        "a bomb in a text": packed(matrix(4, (1, 9), b"time_s", bytes(30_000_000))),
        "a function handle": matrix(16, (1, 1), b"time_s", matrix(2, (1, 1), b"")),
        "an object": matrix(3, (1, 1), b"time_s", matrix(2, (1, 1), b"")),
        "a sparse matrix": matrix(5, (1000, 1), b"time_s"),
        "no dimensions": matrix(6, (), b"time_s"),
        "a hundred dimensions": matrix(6, (1,) * 100, b"time_s"),
        "a name of a megabyte": matrix(6, (1, 1), b"t" * 1_000_000),
        "a struct of a million fields": matrix(2, (1, 1), b"s", names_of_fields(1, b"t" * 10**6)),
        "a struct with names of no length": matrix(2, (1, 1), b"s", names_of_fields(0, bytes(8))),
        "a million variables": matrix(6, (0, 0), b"t") * 20_000,
        "a packed pack": packed(packed(matrix(6, (1, 1), b"time_s"))),
        "half a variable": matrix(6, (1, 1), b"time_s")[:-9],
    }  # fmt: skip
    found = {name: HEAD + others + content for name, content in time.items()}
    distinct = b"".join(matrix(6, (0, 0), b"t%d" % k) for k in range(20_000))
    return found | {"many variables": HEAD + distinct}


def test_files_as_weapons_are_refused_in_one_line_and_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "data.mat"
    for weapon, content in weapons().items():
        path.write_bytes(content)
        tracemalloc.start()
        try:
            assert told(path), weapon
            assert tracemalloc.get_traced_memory()[1] < 20_000_000, weapon
        finally:
            tracemalloc.stop()


def test_files_with_bytes_changed_or_cut_are_answered(tmp_path: Path, record: Record) -> None:
    rng, path = random.Random(7), tmp_path / "data.mat"
    answers = []
    for packed_too in (False, True):
        target = io.BytesIO()
        savemat(target, {"r": columns(record.take(np.arange(300)))}, do_compression=packed_too)
        good = target.getvalue()
        for _ in range(40):
            content = bytearray(good)
            for _ in range(rng.randrange(1, 4)):
                content[rng.randrange(128, min(len(content), 2000))] = rng.randrange(256)
            path.write_bytes(content[: rng.choice([len(content), rng.randrange(len(content))])])
            answers.append(told(path))
    assert any(answers) and not all(answers)
