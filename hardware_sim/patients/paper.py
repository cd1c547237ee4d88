"""The paper's muscle (Le, Markovsky, Freeman, Rogers, section V): sigmoid, then 2nd-order dynamics.

f(u) = a1 (exp(a2 u) - 1) / (exp(a2 u) + a3), eq. (35), and G: T² y'' + 2 ζ T y' + y = f, unit gain at DC.

The paper's input is a continuous pulse width, but a muscle gets pulses: see `HeldPulses`. The paper gives f at one
current. At another the width is scaled by charge: width × current / nominal current.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stimrig.hardware_sim.patients.muscle import NOMINAL_CURRENT_MA, HeldPulses


@dataclass(frozen=True)
class Parameters:
    """Parameters of section V; T in seconds (the paper's T_omega), torque in N·m, widths in µs."""

    a1: float = 6.8994
    a2: float = 0.0410
    a3: float = 2.3897e3
    natural_period_s: float = 0.5284
    damping_ratio: float = 0.6369


class PaperMuscle(HeldPulses):
    """Section V's muscle, driven by single pulses."""

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.parameters = p = parameters or Parameters()
        super().__init__(p.natural_period_s, p.damping_ratio)

    def drive_nm(self, time_s: float, width_us: float, current_ma: float) -> float:  # noqa: ARG002
        """Steady torque of a train of such pulses, N·m; eq. (35)."""
        p = self.parameters
        exponent = p.a2 * width_us * current_ma / NOMINAL_CURRENT_MA
        if exponent <= 0.0:
            return 0.0
        decay = math.exp(-exponent)  # divided through by exp(a2 u): no overflow at 4095 µs
        return p.a1 * (1.0 - decay) / (1.0 + p.a3 * decay)
