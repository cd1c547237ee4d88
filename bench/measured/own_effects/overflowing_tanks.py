"""Two tanks in a row that run out through a hole each, and over their brim: an outsider to muscles, in one file.

Torricelli: what runs out goes with the root of the level. Levels are counted in those at which the inflow would leave
them, so the recruitment curve stays the curve at rest: A h' = k (√in − √h), with τ = A/k at the level 1.
"""

import numpy as np
from numba import njit

from stimrig.effects import Effect, Form, Parameter

STEPS = 4
"""Within a sample."""


@njit
def fill(aim, values, begins, step_s):
    level = np.empty_like(aim)
    for m in range(aim.shape[0]):
        first_s, second_s, brim_1, brim_2, spilt, begin_1, begin_2 = values[m]
        a = b = 0.0
        for k in range(aim.shape[1]):
            if begins[k]:
                a, b = begin_1, begin_2
            inflow, total = np.sqrt(max(aim[m, k], 0.0)), 0.0
            for _ in range(STEPS):
                between = np.sqrt(a)
                a += step_s / STEPS * (inflow - between) / first_s
                over = max(a - brim_1, 0.0) * first_s * STEPS / step_s
                a = max(min(a, brim_1), 0.0)
                b += step_s / STEPS * (between + spilt * over - np.sqrt(b)) / second_s
                b = max(min(b, brim_2), 0.0)
                total += b / STEPS
            level[m, k] = total
    return level


def tanks(drive, p, scene):
    if np.all(p["first_s"] == 0) and np.all(p["second_s"] == 0):
        return drive
    begins = np.arange(drive.shape[1]) == 0
    begins = begins if scene.begins is None else begins | scene.begins
    values = np.stack([p[parameter.name][:, 0] for parameter in PARAMETERS], axis=1)
    return scene.scale_nm * fill(drive / scene.scale_nm, values, begins, scene.step_s)


PARAMETERS = (
    Parameter("first_s", "s", 0.02, 5.0, 0.0, (0.5,), "log", about="time constant of the first tank at level 1"),
    Parameter("second_s", "s", 0.02, 5.0, 0.0, (0.5,), "log", about="of the second"),
    Parameter("brim_1", "1", 0.2, 2.0, np.inf, (1.0,), about="level at which the first runs over"),
    Parameter("brim_2", "1", 0.2, 2.0, np.inf, (1.0,), about="the second"),
    Parameter("spilt", "1", 0.0, 1.0, 0.0, (0.2,), about="share of what runs over that falls into the second"),
    Parameter("begin_1", "1", 0.0, 1.5, 0.0, (0.5,), about="first level at a begin"),
    Parameter("begin_2", "1", 0.0, 1.5, 0.0, (0.5,), about="second level at a begin"),
)


def start(first_s: float, brim: float) -> dict[str, float]:
    """Dynamics of the model itself quick, so that the tanks are the slow ones."""
    own = {"first_s": first_s, "second_s": 0.5, "brim_1": brim, "brim_2": brim, "spilt": 0.2}
    return own | {"begin_1": 0.4, "begin_2": 0.4, "base.time_constant_s": 0.02, "base.damping": 1.0}


EFFECT = Effect(
    id="overflowing_tanks",
    name="Two tanks that run out and over",
    forms=(
        Form(
            "two_tanks",
            "gain",
            "τ h' = √in − √h in each tank, h ≤ brim; a share of what runs over the first falls into the second",
            PARAMETERS,
            tanks,
            batched=True,
            restarts=tuple(start(first_s, brim) for first_s in (0.5, 1.0) for brim in (0.6, 1.0)),
        ),
    ),
    signature="Slower at high levels, and cut off there; quick again as soon as the inflow falls.",
    resembles=("activation_dependent_speed", "sensor_clipping"),
    separated_by="Steps of the inflow at several levels, below the brim.",
    plain="The record is of no muscle: water runs through two tanks.",
    source="Schoukens, Mattsson, Wigren, Noël 2016: Cascaded tanks benchmark",
)
