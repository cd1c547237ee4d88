"""Torque out of CAN frames by their DBC description."""

from __future__ import annotations

import math
import struct
from importlib import resources
from pathlib import Path

import pytest

from stimrig.rig.errors import ConfigError, WireError
from stimrig.rig.wire.dbc import CELL_FAULT, PACKAGED, SampleFrame

COUNTS = """VERSION ""
BS_:
BU_: Cell
BO_ 610 Value: 8 Cell
 SG_ First : 7|16@0- (0.01,0) [0|0] "" Cell
 SG_ Second : 23|16@0- (0.01,0) [0|0] "" Cell
 SG_ Third : 39|16@0- (0.01,0) [0|0] "" Cell
 SG_ Index : 55|8@0+ (1,0) [0|0] "" Cell
"""


def test_the_default_frame():
    frame = SampleFrame(PACKAGED, None, ["Torque_Nm"], "Counter", "Sync")
    assert (frame.frame_id, frame.counter_modulus, frame.samples_per_frame) == (0x181, 65536, 1)
    got = frame.decode(struct.pack("<fHBB", -3.25, 65535, 1, 0))
    assert (got.values, got.counter, got.flag) == ((-3.25,), 65535, 1)
    assert frame.decode(struct.pack("<fHBB", 0, 0, 2, 0)).flag == 0
    for fault in (None, CELL_FAULT):
        frame = SampleFrame(PACKAGED, None, ["Torque_Nm"], "Counter", "Sync", fault=fault)
        for status in (0, 1, 2, 4, 128, 254, 255):
            (value,) = frame.decode(struct.pack("<fHBB", 5.0, 0, status, 0)).values
            assert math.isnan(value) == (fault is not None and status > 1), "every word but the good one"
    assert math.isnan(frame.decode(struct.pack("<fHBB", math.nan, 0, 0, 0)).values[0])


def test_several_samples_of_big_endian_counts(tmp_path: Path):
    path = tmp_path / "counts.dbc"
    path.write_text(COUNTS)
    frame = SampleFrame(str(path), "Value", ["First", "Second", "Third"], "Index", None)
    assert (frame.frame_id, frame.counter_modulus, frame.samples_per_frame) == (610, 256, 3)
    got = frame.decode(struct.pack(">hhhBB", 100, -200, 300, 9, 0))
    assert got.values == pytest.approx((1.0, -2.0, 3.0))
    assert (got.counter, got.flag) == (9, 255)
    without = SampleFrame(str(path), None, ["Second"], None, None)
    assert without.decode(bytes(8)).counter == -1
    assert without.counter_modulus == 0


def test_a_value_that_has_a_word_is_no_reading(tmp_path: Path):
    path = tmp_path / "words.dbc"
    path.write_text(COUNTS + 'VAL_ 610 First -32768 "no reading" 32767 "overload" ;\nVAL_ 610 Index 9 "nine" ;\n')
    frame = SampleFrame(str(path), "Value", ["First", "Second"], "Index", None)
    for raw in (-32768, 32767):
        got = frame.decode(struct.pack(">hhhBB", raw, -32768, 0, 9, 0))
        assert math.isnan(got.values[0]) and got.values[1] == pytest.approx(-327.68) and got.counter == 9


def test_a_float_has_no_words(tmp_path: Path):
    packaged = resources.files("stimrig.rig.wire").joinpath(f"{PACKAGED}.dbc").read_text("utf-8")
    path = tmp_path / "float.dbc"
    path.write_text(packaged + 'VAL_ 385 Torque_Nm 0 "rest" ;\n')
    with pytest.raises(ConfigError, match="Torque_Nm: a floating-point signal has no words"):
        SampleFrame(str(path), None, ["Torque_Nm"], None, None)


def test_a_short_frame_is_told():
    with pytest.raises(WireError, match="does not fit Torque"):
        SampleFrame(PACKAGED, None, ["Torque_Nm"], None, None).decode(b"\0\0")


def test_a_file_that_is_no_dbc(tmp_path: Path):
    path = tmp_path / "x.dbc"
    path.write_text("BO_ hello")
    with pytest.raises(ConfigError, match="not a DBC file"):
        SampleFrame(str(path), None, ["a"], None, None)
    with pytest.raises(ConfigError, match="no file"):
        SampleFrame("nothing", None, ["a"], None, None)


def test_counts_like_those_of_a_gsv_4():
    for n in (1, 2, 4):
        frame = SampleFrame("counts_be16", None, [f"Torque{i + 1}_Nm" for i in range(n)], None, None)
        assert (frame.frame_id, frame.samples_per_frame, frame.counter_modulus) == (610, n, 0)
        data = b"".join(counts.to_bytes(2, "big") for counts in (32768, 65535, 1, 32768 + 655)[:n])
        found = frame.decode(data)
        assert found.values == pytest.approx((0.0, 50.0, -50.0, 655 * 50 / 32767)[:n], abs=1e-6)
        assert (found.counter, found.flag) == (-1, 255)
        with pytest.raises(WireError):
            frame.decode(data[:-1])


def test_three_samples_a_frame_with_a_counter_of_frames():
    frame = SampleFrame("torque_packed3", None, ["Torque1_Nm", "Torque2_Nm", "Torque3_Nm"], "Counter", None)
    found = frame.decode(struct.pack("<hhhH", 500, -250, 1, 40_000))
    assert found.values == pytest.approx((1.0, -0.5, 0.002))
    assert (found.counter, frame.counter_modulus) == (40_000, 65536)
