"""A recording of two muscles at one joint, of the rig's own test, as the emulated joint gives it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stimrig.hardware_sim.joint_records import draw_joint, record
from stimrig.rig.channels import RigChannel
from stimrig.rig.limits import HARD_LIMITS, SUM_LIMITS, for_plan
from stimrig.rig.messages import ChannelPlan, Profile, TestPlan
from stimrig.rig.plan import build

NAMES = ("biceps", "triceps")
HEADER = "time_s,biceps_pulse_width_us,triceps_pulse_width_us,torque_nm,segment"


def write_csv(path: Path, seed: int = 3) -> Path:
    """The default test of both muscles, as a table."""
    profile = Profile(current_ma=20.0, max_pulse_width_us=300.0, max_torque_nm=30.0)
    plans = [ChannelPlan(name=name, profile=profile) for name in NAMES]
    plan = TestPlan(test_id="T1", participant="P1", kind="muscles", profile=profile, channels=plans, segments=None)
    built = build(plan, for_plan({**HARD_LIMITS, **SUM_LIMITS}, plan), [RigChannel(n, "", "", "") for n in NAMES])
    found = record(draw_joint(seed), built.pulse_width_us[::2], built.pulse_width_us[1::2], seed=seed)
    place = np.searchsorted([s.end / 80.0 for s in built.segments[:-1]], found["time_s"], side="right")
    columns = zip(found["time_s"], found["first_us"], found["second_us"], found["torque_nm"], place, strict=True)
    rows = [f"{t:.4f},{a:g},{b:g},{y:.6g},{built.segments[k].name}" for t, a, b, y, k in columns]
    path.write_text("\n".join([HEADER, *rows, ""]))
    return path
