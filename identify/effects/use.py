"""Shared parts of the free effects of use: a slow state that fills with work, its curve, and words for sizes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import FreeLaw, filled
from stimrig.identify.effects.base import Parameter

FILL = Parameter("fill_s", "s", 0.5, 200.0, 0.0, (20.0, 4.0, 50.0), "log", about="time constant under full work")
EMPTY = Parameter("empty_s", "s", 0.5, 400.0, 0.0, (40.0, 10.0, 40.0), "log", about="time constant at rest")
STATE = {"fill_s": FreeLaw.FILL_S, "empty_s": FreeLaw.EMPTY_S}
BY = {"by_torque": {}, "by_pulses": {FreeLaw.BY_PULSES: 1.0}, "by_drive": {FreeLaw.BY_DRIVE: 1.0}}
WORK_S, STEP_S = 20.0, 0.5
"""Full work in the picture, then rest."""
TIME_S = np.arange(0.0, 4.0 * WORK_S + STEP_S, STEP_S)
DRIVER = "time, full work for 20 s, then rest (s)"


def course(values: Mapping[str, float]) -> np.ndarray:
    """The slow state at `TIME_S`, 0 to 1."""
    state, levels = 0.0, []
    for at in TIME_S:
        levels.append(state)
        up, down = (1.0 / values["fill_s"], 0.0) if at < WORK_S else (0.0, 1.0 / values["empty_s"])
        state = filled(state, up, down, STEP_S)
    return np.array(levels)


def percent(share: float) -> str:
    """A change, with its sign."""
    return f"{100.0 * share:+.0f} %"


def seconds(value_s: float) -> str:
    """A time constant as people say it."""
    return f"{value_s:.2g} s" if value_s < 100.0 else f"{value_s / 60.0:.2g} min"
