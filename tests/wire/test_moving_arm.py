"""An arm that moves, over serial line and CAN bus: what is sealed is where the joint was, beside its torque."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stimrig.identify.records import read
from stimrig.identify.records.record import Record
from tests.harness.processes import Bench, default_plan

pytestmark = pytest.mark.wire

HZ, SIZE_DEG, MIDDLE_DEG, INERTIA_KG_M2 = 0.5, 25.0, 85.0, 0.4
PASSIVE: dict[str, Any] = {
    "kind": "passive",
    "segments": [{"name": "passive", "sequence": "rest", "settings": {"duration_s": 8.0}}],
    "angle": {"range_rad": [0.0, 2.6], "still_s": 2.0},
}
ARM = f"""
mode = "waves"
[movement]
hz = [{HZ}]
deg = [{SIZE_DEG}]
phase_rad = [0.0]
middle_deg = {MIDDLE_DEG}
[mechanics]
inertia_kg_m2 = {INERTIA_KG_M2}
[passive]
law = "none"
"""


def recorded(folder: Path, *options: str) -> Record:
    """A passive test of a heavy forearm that swings."""
    (folder / "arm.toml").write_text(ARM)
    bench = Bench(folder, "--arm", str(folder / "arm.toml"), "--noise-seed", "1", *options)
    try:
        client = bench.start_rig()
        client.ask("subscribe")
        end_s = time.monotonic() + 20
        while client.status()["angle"]["angle_rad"] is None:
            assert time.monotonic() < end_s, "no angle has come"
            time.sleep(0.05)
        reply = client.start(default_plan("moving", **PASSIVE))
        assert reply["ok"], reply
        event = client.wait_finished("moving")
        assert event["outcome"] == "completed", event
        return read(Path(event["recording_path"]))
    finally:
        bench.close()


def wave(time_s: np.ndarray, values: np.ndarray) -> tuple[float, float, float]:
    """Mean, amplitude and phase of the movement's wave in a column."""
    turn = 2.0 * math.pi * HZ * time_s
    basis = np.column_stack([np.ones_like(turn), np.sin(turn), np.cos(turn)])
    (mean, sine, cosine), *_ = np.linalg.lstsq(basis, values, rcond=None)
    return float(mean), float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))


def test_the_sealed_angle_is_the_joints_and_the_torque_is_of_its_inertia(tmp_path: Path) -> None:
    record = recorded(tmp_path, "--angle-offset-deg", "40", "--angle-direction", "-1", "--angle-clock-ppm", "300")
    assert record.angle_rad is not None and record.velocity_rad_s is not None
    mean, size, phase = wave(record.time_s, record.angle_rad)
    assert math.degrees(mean) == pytest.approx(MIDDLE_DEG, abs=0.2)
    assert math.degrees(size) == pytest.approx(SIZE_DEG, rel=0.01)
    fitted = mean + size * np.sin(2.0 * math.pi * HZ * record.time_s + phase)
    assert np.degrees(np.std(record.angle_rad - fitted)) < 0.15
    _, fast, ahead = wave(record.time_s, record.velocity_rad_s)
    assert fast == pytest.approx(2.0 * math.pi * HZ * size, rel=0.02)
    assert math.remainder(ahead - phase - 0.5 * math.pi, 2.0 * math.pi) == pytest.approx(0.0, abs=0.05)
    _, torque_nm, in_phase = wave(record.time_s, record.torque_nm)
    assert torque_nm == pytest.approx(INERTIA_KG_M2 * (2.0 * math.pi * HZ) ** 2 * size, rel=0.05)
    late_rad = math.remainder(in_phase - phase, 2.0 * math.pi)
    assert late_rad == pytest.approx(0.0, abs=0.1), "the cell's −I ẍ goes with the angle, if their times agree"
