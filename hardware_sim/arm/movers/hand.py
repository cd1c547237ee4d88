"""A therapist's hand, which is not quite steady: no two sweeps are alike, it wanders slowly and trembles.

Each sweep has a speed and a turning point of its own and a pause of its own; the speed within it goes up and down. The
hand wanders by slow waves (0.1 to 0.6 Hz) and trembles at 8 to 12 Hz (physiological tremor), so little that the cell
feels some mN·m of the forearm's inertia.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from stimrig.hardware_sim.arm.motion import FASTEST_DEG_S, SLOWEST_DEG_S, Begin, Drive, Motion, radians, within
from stimrig.hardware_sim.arm.servo import Leg, Path, Servo

BANDWIDTH_HZ = 3.0
PIECES = 5
"""A sweep is made of so many pieces, each at its own speed."""


class Mover:
    """Sweeps between `from_deg` and `to_deg` at about `deg_s`; with one of them alone, or none, it tries to hold still.

    `unsteady` scales everything that is random about it; 0 is a steady hand.
    """

    holds = True

    def __init__(
        self,
        begin: Begin,
        from_deg: float | None = None,
        to_deg: float | None = None,
        deg_s: float = 30.0,
        pause_s: float = 0.6,
        wander_deg: float = 0.6,
        tremor_deg: float = 0.003,
        unsteady: float = 1.0,
    ) -> None:
        rng = np.random.default_rng([begin.seed, 0xA4D])
        first_rad = begin.motion.angle_rad if from_deg is None else radians("from_deg", from_deg)
        last_rad = first_rad if to_deg is None else radians("to_deg", to_deg)
        rad_s = radians("deg_s", deg_s, SLOWEST_DEG_S, FASTEST_DEG_S)
        pause_s = within("pause_s", pause_s, 0.0, 3600.0)
        uneven = within("unsteady", unsteady, 0.0, 3.0)
        legs = _legs(rng, begin.motion.angle_rad, (first_rad, last_rad), rad_s, pause_s, uneven)
        path = Path(begin.time_s, begin.motion.angle_rad, legs)
        wander_rad = uneven * radians("wander_deg", wander_deg, 0.0, 10.0)
        tremor_rad = uneven * radians("tremor_deg", tremor_deg, 0.0, 1.0)
        waves = [*_wander(rng, wander_rad), *_tremor(rng, tremor_rad)]

        def reference_rad(time_s: float) -> float:
            since_s = time_s - begin.time_s
            return path.at(time_s) + sum(a * math.sin(w * since_s + phase) for a, w, phase in waves)

        self._servo = Servo(begin, reference_rad, BANDWIDTH_HZ)

    def advance(self, time_s: float, drive: Drive) -> Motion:  # noqa: ARG002
        """The motion at `time_s`."""
        return self._servo.at(time_s)


def _legs(
    rng: np.random.Generator, at_rad: float, ends_rad: tuple[float, float], rad_s: float, pause_s: float, uneven: float
) -> Iterator[Leg]:
    while True:
        for end_rad in ends_rad:
            miss_rad = uneven * math.radians(2.0) * float(rng.standard_normal())
            goal_rad = end_rad + (miss_rad if ends_rad[0] != ends_rad[1] else 0.0)
            speed = rad_s * math.exp(0.15 * uneven * float(rng.standard_normal()))
            way_rad = (goal_rad - at_rad) / PIECES
            for piece in range(1, PIECES + 1):
                own = speed * math.exp(0.12 * uneven * float(rng.standard_normal()))
                rest_s = pause_s * math.exp(0.5 * uneven * float(rng.standard_normal())) if piece == PIECES else 0.0
                yield Leg(at_rad + piece * way_rad, own, rest_s)
            at_rad = goal_rad


def _wander(rng: np.random.Generator, size_rad: float) -> list[tuple[float, float, float]]:
    """Amplitude, rad, angular frequency, rad/s, and phase of slow waves whose sum has this standard deviation."""
    count = 4
    amplitude = size_rad * math.sqrt(2.0 / count)
    return [
        (amplitude, 2.0 * math.pi * float(rng.uniform(0.1, 0.6)), float(rng.uniform(0.0, 2.0 * math.pi)))
        for _ in range(count)
    ]


def _tremor(rng: np.random.Generator, size_rad: float) -> list[tuple[float, float, float]]:
    """Two close lines that beat; larger than asked by what the arm's own inertia takes off them."""
    waves = []
    for _ in range(2):
        hz = float(rng.uniform(8.0, 12.0))
        waves.append((size_rad * (hz / BANDWIDTH_HZ) ** 2, 2.0 * math.pi * hz, float(rng.uniform(0.0, 2.0 * math.pi))))
    return waves
