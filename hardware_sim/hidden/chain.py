"""Stages in series, run by one compiled loop: a whole record at once or one step at a time; a muscle of such stages."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from stimrig.hardware_sim.hidden import kernels
from stimrig.hardware_sim.hidden.base import Base
from stimrig.hardware_sim.hidden.design import Design
from stimrig.hardware_sim.hidden.forms import Formulation
from stimrig.hardware_sim.hidden.kernels import (
    ANGLE_RAD,
    CONTEXT_SIZE,
    COUNT,
    LARGEST_NM,
    LINGERING,
    PAUSE_S,
    PULSE,
    RECRUITED,
    ROW,
    SINCE_S,
    SLOTS,
    SPEED,
    STEP_S,
    TIME_S,
    VELOCITY_RAD_S,
    WIDTH_US,
    Floats,
    NotSuited,
    Stage,
)

_call: Any = kernels.call_kernel  # to a type checker, an intrinsic still has its typing context
TRAIN_GAP_S = 0.15
"""A pause longer than this starts a new train."""
_REPLACED = ("recruitment", "dynamics")


@nb.njit(cache=True)
def _run(
    addresses: Any, recruiting: Any, p: Any, s: Any, c: Any, x_in: Any, pulse: Any, angle: Any, velocity: Any,
    first: Any, out: Any,
):  # fmt: skip
    c_address = c.ctypes.data
    for k in range(x_in.size):
        c[TIME_S] = (first + k) * c[STEP_S]
        c[WIDTH_US] = x_in[k]
        c[PULSE] = pulse[k]
        c[ANGLE_RAD] = angle[k]
        c[VELOCITY_RAD_S] = velocity[k]
        c[SPEED] = 1.0
        c[SINCE_S] += c[STEP_S]
        if pulse[k] > 0.0:
            if c[SINCE_S] > TRAIN_GAP_S:
                c[PAUSE_S] = c[SINCE_S]
                c[COUNT] = 0.0
            c[COUNT] += 1.0
            c[SINCE_S] = 0.0
        x = x_in[k]
        for i in range(addresses.size):
            if i == recruiting:
                c[RECRUITED] = x
                x += c[LINGERING]
            x = _call(addresses[i], x, p[i].ctypes.data, s[i].ctypes.data, c_address)
        out[k] = x


class Chain:
    """Stages in the order of their slots, with their state; within a slot they keep the given order.

    `largest_nm` is the base's largest torque: activation and force are shares of it, N·m. `step_s`: of the simulation.
    """

    def __init__(self, stages: list[Stage], largest_nm: float, step_s: float) -> None:
        ordered = sorted(stages, key=lambda stage: SLOTS.index(stage.slot))
        addresses = np.array([stage.kernel.compiled.address for stage in ordered], dtype=np.int64)
        recruiting = sum(SLOTS.index(stage.slot) <= SLOTS.index("recruitment") for stage in ordered)
        rows = [stage.rows() for stage in ordered]
        parameters = np.array([p for p, _ in rows]).reshape(-1, ROW)
        self._s = np.array([s for _, s in rows]).reshape(-1, ROW)
        self._c = np.zeros(CONTEXT_SIZE)
        self._c[STEP_S] = step_s
        self._c[SINCE_S] = 10.0
        self._c[LARGEST_NM] = largest_nm
        self._stages = (addresses, recruiting, parameters, self._s, self._c)
        self._steps = 0.0
        self._column = np.zeros((5, 1))

    def run(self, x: Floats, pulse: Floats, angle_rad: Floats, velocity_rad_s: Floats) -> Floats:
        """Advance by as many steps as `x` has entries; the last stage's output after each step."""
        out = np.empty(x.size)
        _run(*self._stages, x, pulse, angle_rad, velocity_rad_s, self._steps, out)
        self._steps += x.size
        return out

    def step(
        self, x: float, pulse: float, at_step: float | None = None, joint: tuple[float, float] = (0.0, 0.0),
        lingering: float = 0.0,
    ) -> float:  # fmt: skip
        """One step with the joint at this angle, rad, and velocity, rad/s; `at_step` sets the time, in steps.

        `lingering` is added to what `x` recruits.
        """
        column = self._column
        column[0, 0], column[1, 0], column[2, 0], column[3, 0] = x, pulse, *joint
        if at_step is not None:
            self._steps = at_step
        self._c[LINGERING] = lingering
        _run(*self._stages, column[0], column[1], column[2], column[3], self._steps, column[4])
        self._steps += 1.0
        return float(column[4, 0])

    @property
    def recruited(self) -> float:
        """The torque recruited by the last step's width."""
        return float(self._c[RECRUITED])

    def save(self) -> tuple[Floats, Floats, float]:
        """The state as it is now."""
        return self._s.copy(), self._c.copy(), self._steps

    def restore(self, saved: tuple[Floats, Floats, float]) -> None:
        """Go back to a saved state."""
        self._s[:], self._c[:], self._steps = saved


def combine(base: Base, hidden: list[tuple[Formulation, float]]) -> list[Stage]:
    """The base's stages together with those of the effects. Raises NotSuited: two effects replace the same stage."""
    stages = [stage for formulation, magnitude in hidden for stage in formulation.build(magnitude)]
    replaced_slots = [stage.slot for stage in stages if stage.slot in _REPLACED]
    if len(set(replaced_slots)) < len(replaced_slots):
        raise NotSuited("both effects replace the same stage")
    return [stage for stage in base.stages() if stage.slot not in replaced_slots] + stages


def split(stages: list[Stage]) -> tuple[list[Stage], list[Stage]]:
    """Stages before and after the measurement noise."""
    cut = SLOTS.index("converter")
    return [s for s in stages if SLOTS.index(s.slot) < cut], [s for s in stages if SLOTS.index(s.slot) >= cut]


def simulate(base: Base, stages: list[Stage], design: Design, step_s: float, noise_nm: Floats | None = None) -> Floats:
    """Torque at every step of the design, N·m; the noise is added before the converter."""
    width, pulse, angle, velocity = design.fine(step_s)
    before, after = split(stages)
    torque = Chain(before, base.largest_nm, step_s).run(width, pulse, angle, velocity)
    if noise_nm is not None:
        torque = torque + noise_nm
    if after:
        torque = Chain(after, base.largest_nm, step_s).run(torque, pulse, angle, velocity)
    return torque
