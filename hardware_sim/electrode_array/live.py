"""An array in real time: pulses through the elements that a switch has connected in, torque out.

Its dynamics are of second order, T L(0.1, 0.3) s and damping U(0.7, 1.1), by the seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from stimrig.hardware_sim.electrode_array.limb import log_uniform
from stimrig.hardware_sim.electrode_array.session import Choice, Session
from stimrig.hardware_sim.hidden.scenario import rng_of
from stimrig.hardware_sim.patients.muscle import HeldPulses


class ArrayMuscle(HeldPulses):
    """The wanted muscle; it implements the `Muscle` protocol. `closed` says which elements are connected."""

    def __init__(self, session: Session) -> None:
        rng = rng_of(session.array.seed, "electrode array, dynamics")
        super().__init__(
            log_uniform(rng, 0.1, 0.3), float(rng.uniform(0.7, 1.1)), pulse_period_s=0.025, late_periods=1.2
        )
        self.session = session
        self.closed: Callable[[], Choice] = tuple
        self._last: tuple[Choice, float, float] | None = None

    def drive_nm(self, time_s: float, width_us: float, current_ma: float) -> float:  # noqa: ARG002
        """Steady torque of a train of such pulses, N·m."""
        elements = self.closed()
        if not (elements and current_ma > 0.0):
            return 0.0
        self._last = elements, width_us, current_ma
        return self.session.truth(*self._last).torque_nm

    def asked(self) -> dict[str, Any]:
        """What clinician and person say of the last pulse's train, and the truth; the skin creeps as by a stimulus."""
        if self._last is None:
            return {"elements": []}
        elements, width_us, current_ma = self._last
        truth = asdict(self.session.truth(*self._last))
        seen = self.session.stimulate(*self._last)
        said = {"spill": seen.spill, "comfort": seen.comfort, "truth": truth}
        return {"elements": list(elements), "width_us": width_us, "current_ma": current_ma, **said}
