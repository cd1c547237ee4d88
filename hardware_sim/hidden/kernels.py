"""Stages of hidden muscles: small compiled functions, each with its parameters and its state.

Every kernel takes `(x, p, s, c)`: its input signal, its parameters, its state and the context that all stages share.
It returns its output signal. Kernels are C functions called by address, so that any set of them runs in one compiled
loop without another compilation, and one step of a live muscle costs about a microsecond.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ROW = 1024
"""Most parameters, and most states, of a stage."""

# The context: one array that all stages of a muscle read, and some write.
TIME_S = 0
STEP_S = 1
WIDTH_US = 2  # what the stimulator sends, before any electrode effect
PULSE = 3  # 1 in the step a pulse with some width arrives in
SINCE_S = 4  # since the last such pulse
COUNT = 5  # pulses of this train
PAUSE_S = 6  # the pause before this train
ANGLE_RAD = 7
VELOCITY_RAD_S = 8
ACTIVATION = 9  # recruited share, 0 to 1, before any gain
FORCE = 10  # output of the dynamics one step before, as a share of the largest torque
SPEED = 11  # factor on the rates of the dynamics; 1 unless an earlier stage changes it
LARGEST_NM = 12
RECRUITED = 13  # what comes out of recruitment
LINGERING = 14  # what earlier pulses still recruit besides
CONTEXT_SIZE = 16

SLOTS = (
    "electrode",  # pulse width -> pulse width at the nerve
    "recruitment",  # -> recruited torque
    "gain",
    "delay",
    "dynamics",  # -> torque
    "structure",  # tendon, fixture
    "joint",
    "additive",
    "sensor",  # before the measurement noise
    "converter",  # after it
)

_NUMBER = nb.float64
_POINTER = types.CPointer(_NUMBER)
_SIGNATURE = _NUMBER(_NUMBER, _POINTER, _POINTER, _POINTER)


@dataclass(frozen=True, eq=False)
class Kernel:
    """A stage's function `(x, p, s, c) -> float`, and the slot of the muscle that it belongs to."""

    slot: str
    function: Callable[..., float]

    @cached_property
    def compiled(self) -> Any:
        """The C function, compiled when it is first run."""
        return nb.cfunc(_SIGNATURE, cache=True)(self.function)


def kernel(slot: str) -> Callable[[Callable[..., float]], Kernel]:
    """Make a function the kernel of a stage in this slot."""
    return lambda function: Kernel(slot, function)


helper: Any = nb.njit(cache=True)
"""Decorator of functions that several kernels call."""


@intrinsic
def call_kernel(_typing: Any, _address: Any, _x: Any, _p: Any, _s: Any, _c: Any) -> Any:
    """Call a kernel by its address; parameters, state and context by theirs."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        double = ir.DoubleType()
        pointer = double.as_pointer()
        function_type = ir.FunctionType(double, [double, pointer, pointer, pointer])
        function = builder.inttoptr(arguments[0], function_type.as_pointer())
        pointers = [builder.inttoptr(argument, pointer) for argument in arguments[2:]]
        return builder.call(function, [arguments[1], *pointers])

    return _NUMBER(types.int64, _NUMBER, types.int64, types.int64, types.int64), generate


@helper
def uniform(s: Any, i: int) -> float:
    """A number in [0, 1) from the generator whose state is s[i] (a whole number under 2^32)."""
    s[i] = (1664525.0 * s[i] + 1013904223.0) % 4294967296.0
    return s[i] / 4294967296.0


@helper
def normal(s: Any, i: int) -> float:
    """A standard normal number from the same generator (Box-Muller)."""
    a = uniform(s, i)
    b = uniform(s, i)
    return math.sqrt(-2.0 * math.log(a + 1e-12)) * math.cos(2.0 * math.pi * b)


@helper
def smooth_table(p: Any, first: int, count: int, position: float) -> float:
    """Catmull-Rom curve through p[first : first + count] at `position` (0 is the first knot); held at the end."""
    if position >= count - 1:
        return p[first + count - 1]
    i = int(position)
    r = position - i
    b = p[first + i]
    d = p[first + i + 1]
    a = p[first + i - 1] if i > 0 else b
    e = p[first + i + 2] if i + 2 < count else d
    return b + 0.5 * r * (d - a + r * (2 * a - 5 * b + 4 * d - e + r * (3 * (b - d) + e - a)))


@dataclass(frozen=True)
class Stage:
    """A kernel with its parameters and its state at the start."""

    kernel: Kernel
    parameters: Any = ()
    state: Any = ()


class NotSuited(Exception):
    """This form does not suit this base muscle; draw another."""
