"""Stages in series, run by one compiled loop: a whole record at once or one step at a time; a muscle of such stages."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from stimrig.hardware_sim.hidden import kernels
from stimrig.hardware_sim.hidden.base import Base
from stimrig.hardware_sim.hidden.design import Design
from stimrig.hardware_sim.hidden.forms import Form
from stimrig.hardware_sim.hidden.kernels import CONTEXT_SIZE, ROW, SLOTS, Floats, NotSuited, Stage

_call: Any = kernels.call_kernel  # to a type checker, an intrinsic still has its typing context
TRAIN_GAP_S = 0.15
"""A pause longer than this starts a new train."""
_REPLACED = ("recruitment", "dynamics")


@nb.njit(cache=True)
def _run(addresses: Any, recruits: Any, moves: Any, p: Any, s: Any, c: Any, columns: Any, first: Any, out: Any):
    """`recruits`, `moves`: the stages of recruitment and dynamics, or -1. `columns`: width, pulse, angle, velocity."""
    c_address = c.ctypes.data
    for k in range(out.size):
        c[kernels.TIME_S] = (first + k) * c[kernels.STEP_S]
        c[kernels.WIDTH_US] = columns[0, k]
        c[kernels.PULSE] = columns[1, k]
        c[kernels.ANGLE_RAD] = columns[2, k]
        c[kernels.VELOCITY_RAD_S] = columns[3, k]
        c[kernels.SPEED] = 1.0
        c[kernels.SINCE_S] += c[kernels.STEP_S]
        if columns[1, k] > 0.0:
            if c[kernels.SINCE_S] > TRAIN_GAP_S:
                c[kernels.PAUSE_S] = c[kernels.SINCE_S]
                c[kernels.COUNT] = 0.0
            c[kernels.COUNT] += 1.0
            c[kernels.SINCE_S] = 0.0
        x = columns[0, k]
        for i in range(addresses.size):
            x = _call(addresses[i], x, p[i].ctypes.data, s[i].ctypes.data, c_address)
            if i == recruits:
                c[kernels.RECRUITED] = x
                c[kernels.ACTIVATION] = x / c[kernels.LARGEST_NM]
                x += c[kernels.LINGERING]
            elif i == moves:
                c[kernels.FORCE] = x / c[kernels.LARGEST_NM]
        out[k] = x


class Chain:
    """Stages in the order of their slots, with their state; within a slot they keep the given order.

    `largest_nm` is the base's largest torque: activation and force are shares of it, N·m. `step_s`: of the simulation.
    """

    def __init__(self, stages: list[Stage], largest_nm: float, step_s: float) -> None:
        ordered = sorted(stages, key=lambda stage: SLOTS.index(stage.kernel.slot))
        slots = [stage.kernel.slot for stage in ordered]
        addresses = np.array([stage.kernel.compiled.address for stage in ordered], dtype=np.int64)
        parameters, self._s = np.zeros((2, len(ordered), ROW))
        for row, stage in enumerate(ordered):
            parameters[row, : len(stage.parameters)] = stage.parameters
            self._s[row, : len(stage.state)] = stage.state
        self._c = np.zeros(CONTEXT_SIZE)
        self._c[kernels.STEP_S] = step_s
        self._c[kernels.SINCE_S] = 10.0
        self._c[kernels.LARGEST_NM] = largest_nm
        recruits, moves = (slots.index(slot) if slot in slots else -1 for slot in _REPLACED)
        self._stages = (addresses, recruits, moves, parameters, self._s, self._c)
        self._steps = 0.0
        self._column, self._out = np.zeros((4, 1)), np.zeros(1)

    def run(self, x: Floats, pulse: Floats, angle_rad: Floats, velocity_rad_s: Floats) -> Floats:
        """Advance by as many steps as `x` has entries; the last stage's output after each step."""
        out = np.empty(x.size)
        _run(*self._stages, np.stack([x, pulse, angle_rad, velocity_rad_s]), self._steps, out)
        self._steps += x.size
        return out

    def step(
        self,
        x: float,
        pulse: float,
        at_step: float,
        joint: tuple[float, float] = (0.0, 0.0),
        lingering: float = 0.0,
    ) -> float:
        """One step at this time, in steps, with the joint at this angle, rad, and velocity, rad/s.

        `lingering` is added to what `x` recruits.
        """
        self._column[:, 0] = x, pulse, *joint
        self._c[kernels.LINGERING] = lingering
        _run(*self._stages, self._column, at_step, self._out)
        return float(self._out[0])

    @property
    def recruited(self) -> float:
        """The torque recruited by the last step's width."""
        return float(self._c[kernels.RECRUITED])

    def save(self) -> tuple[Floats, Floats]:
        """The state as it is now."""
        return self._s.copy(), self._c.copy()

    def restore(self, saved: tuple[Floats, Floats]) -> None:
        """Go back to a saved state."""
        self._s[:], self._c[:] = saved


def combine(base: Base, hidden: list[tuple[Form, float]]) -> list[Stage]:
    """The base's stages together with those of the effects. Raises NotSuited: two effects replace the same stage."""
    stages = [stage for form, magnitude in hidden if magnitude for stage in form.build(magnitude)]
    replaced_slots = [stage.kernel.slot for stage in stages if stage.kernel.slot in _REPLACED]
    if len(set(replaced_slots)) < len(replaced_slots):
        raise NotSuited("both effects replace the same stage")
    return [stage for stage in base.stages() if stage.kernel.slot not in replaced_slots] + stages


def split(stages: list[Stage]) -> tuple[list[Stage], list[Stage]]:
    """Stages before and after the measurement noise."""
    after = [stage for stage in stages if stage.kernel.slot == "converter"]
    return [stage for stage in stages if stage.kernel.slot != "converter"], after


def simulate(base: Base, stages: list[Stage], design: Design, step_s: float, noise_nm: Floats | None = None) -> Floats:
    """Torque at every step of the design, N·m; the noise is added before the converter."""
    width, *joint = design.fine(step_s)
    before, after = split(stages)
    torque = Chain(before, base.largest_nm, step_s).run(width, *joint)
    if noise_nm is not None:
        torque = torque + noise_nm
    return Chain(after, base.largest_nm, step_s).run(torque, *joint) if after else torque
