"""What lies under an array: nerves of the wanted muscle and of its neighbour, and pain receptors of the skin.

A place in the limb is (x along it, y around it, depth), mm; (0, 0) is the middle of the wanted muscle's belly. A point
current on the skin that returns far away excites a nerve at distance r by 1 / r^p, here

    excitation = I / (1 + chronaxie / width) · Σ share_e · ((12 mm)² / (r_e² + (4 mm)²))^(p/2)

over the elements e, which share the current. The first factor is Weiss's law of strength and duration. Of the units
that a nerve feeds, the share Φ(ln(excitation / threshold) / spread) fires. Motor points feed parts of a muscle, the
nerve's branch feeds all of it: its units fire if either reaches them, in any combination, so the shares join as
1 - (1 - a)(1 - b). Pain is 10 · z / (1 + z), z = (Σ over elements (current / receptors' threshold)^m)^(n/m): two
elements with half the current each hurt less than one with all of it, by 2^(1/m) / 2 of the current.

How a limb is drawn (U: uniform, N: normal, L: log-uniform; mm and mA):

- *Wanted muscle*: largest torque L(3, 15) N·m. One to three motor points with equal probability, x U(-18, 18), y
  N(0, 7), depth U(6, 15), each feeding a share from Dirichlet(4). Its branch runs from x ±U(15, 30), y N(0, 8), depth
  U(12, 20) to their middle, and is reached where it is nearest.
- *Neighbour* (it extends the wrist): one or two motor points on one side, x U(-20, 20), y ±U(14, 27), depth U(5, 14).
  With probability 0.35 its axons run in the branch, too.
- *Thresholds*: of half the units of a motor point L(7, 14), of the branch U(0.7, 1.1) of that, of the neighbour's axons
  in it U(1, 1.6) of the branch's; each point's own L(0.8, 1.25) besides. Spread U(0.25, 0.45), p U(1.6, 2.4), chronaxie
  of motor axons U(120, 250) µs.
- *Pain*: threshold L(5, 10) mA by a chronaxie of U(350, 600) µs; n U(2, 3.5), m L(1.1, 2.5). It varies
  over the skin by a factor of exp(sum of six bumps, N(0, 0.25) each, 12 mm wide).
- Drawn again until an element of the array gives 30 % of the largest torque with pain of at most 4: otherwise a
  clinician would move the array.

ASSUMED, for want of public data with known truth: all of the above numbers but these. Distances and depths are those of
forearm and upper-arm anatomy in outline; chronaxies are within published ranges (motor axons about 0.1 to 0.3 ms,
pain fibres longer); the power p lies between a point source's field (2) and what fat, fascia and the element's size
make of it. Layers, anisotropy of muscle, and the return electrode's own effect are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]

REFERENCE_MM, ELEMENT_MM = 12.0, 4.0
BUMPS, BUMP_MM = 6, 12.0


class Response(NamedTuple):
    """Steady torque of the wanted muscle (N·m), recruited share of its neighbour (0 to 1), pain (0 to 10)."""

    torque_nm: Any
    spill: Any
    pain: Any


@dataclass(frozen=True, eq=False)
class Nerve:
    """A muscle's motor points with their parts of it, and what its axons in the branch need."""

    points_mm: Floats  # shape (n, 3)
    shares: Floats
    thresholds_ma: Floats
    branch_ma: float  # infinite: it has no axons there

    def recruited(self, at_points_ma: Floats, at_branch_ma: Floats, spread: float) -> Floats:
        """Share of the muscle's units that fires, for excitations of shape (choices, points) and (choices,)."""
        by_point = _firing(at_points_ma, self.thresholds_ma, spread)
        by_branch = _firing(at_branch_ma, self.branch_ma, spread)[:, None]
        return (1.0 - (1.0 - by_point) * (1.0 - by_branch)) @ self.shares


@dataclass(frozen=True, eq=False)
class Limb:
    """All that the skin covers."""

    largest_nm: float
    wanted: Nerve
    neighbour: Nerve
    branch_mm: Floats  # its two ends, shape (2, 3)
    spread: float
    power: float
    motor_chronaxie_us: float
    pain_ma: float
    pain_chronaxie_us: float
    pain_power: float
    pain_summation: float
    bumps: Floats  # shape (BUMPS, 3): x, y, log of the factor

    def respond(self, places_mm: Floats, shares: Floats, width_us: float, current_ma: Floats | float) -> Response:
        """What stimulation does.

        Parameters
        ----------
        places_mm : ndarray, shape (elements, 2)
            Of the elements on the skin.
        shares : ndarray, shape (choices, elements)
            Of the current.
        current_ma : float or ndarray, shape (choices,)
            In all elements together.
        """
        motor_ma = current_ma / (1.0 + self.motor_chronaxie_us / width_us) * np.ones(len(shares))
        at_branch_ma = motor_ma * (shares @ self._branch_reach(places_mm))
        fired = [
            nerve.recruited(
                motor_ma[:, None] * (shares @ self._reach(places_mm, nerve.points_mm)), at_branch_ma, self.spread
            )
            for nerve in (self.wanted, self.neighbour)
        ]
        skin_ma = current_ma / (1.0 + self.pain_chronaxie_us / width_us) * np.ones(len(shares))
        pressed = (skin_ma[:, None] * shares / self._pain_thresholds_ma(places_mm)) ** self.pain_summation
        felt = pressed.sum(axis=1) ** (self.pain_power / self.pain_summation)
        return Response(self.largest_nm * fired[0], fired[1], 10.0 * felt / (1.0 + felt))

    def _reach(self, places_mm: Floats, points_mm: Floats) -> Floats:
        """Excitation of each point by each element, for 1 mA, shape (elements, points)."""
        skin = places_mm[:, None, :] - points_mm[None, :, :2]
        squared = (skin**2).sum(axis=2) + points_mm[:, 2] ** 2
        return (REFERENCE_MM**2 / (squared + ELEMENT_MM**2)) ** (self.power / 2.0)

    def _branch_reach(self, places_mm: Floats) -> Floats:
        """The same of the branch, where each element is nearest to it."""
        begin, run = self.branch_mm[0], self.branch_mm[1] - self.branch_mm[0]
        skin = np.column_stack([places_mm, np.zeros(len(places_mm))]) - begin
        nearest = begin + np.clip(skin @ run / (run @ run), 0.0, 1.0)[:, None] * run
        return np.array(
            [self._reach(place[None], point[None])[0, 0] for place, point in zip(places_mm, nearest, strict=True)]
        )

    def _pain_thresholds_ma(self, places_mm: Floats) -> Floats:
        squared = ((places_mm[:, None, :] - self.bumps[None, :, :2]) ** 2).sum(axis=2)
        return self.pain_ma * np.exp(np.exp(-squared / (2.0 * BUMP_MM**2)) @ self.bumps[:, 2])


def _firing(excitation_ma: Floats, threshold_ma: Any, spread: float) -> Floats:
    with np.errstate(divide="ignore"):
        return ndtr(np.log(excitation_ma / threshold_ma) / spread)


def draw_limb(rng: Generator) -> Limb:
    """A limb; whether an array reaches enough of it is not looked at."""
    points = int(rng.integers(1, 4))
    wanted_mm = np.column_stack(
        [rng.uniform(-18.0, 18.0, points), rng.normal(0.0, 7.0, points), rng.uniform(6.0, 15.0, points)]
    )
    entry_mm = [rng.choice([-1.0, 1.0]) * rng.uniform(15.0, 30.0), rng.normal(0.0, 8.0), rng.uniform(12.0, 20.0)]
    beside, side = int(rng.integers(1, 3)), float(rng.choice([-1.0, 1.0]))
    neighbour_mm = np.column_stack(
        [rng.uniform(-20.0, 20.0, beside), side * rng.uniform(14.0, 27.0, beside), rng.uniform(5.0, 14.0, beside)]
    )
    motor_ma = log_uniform(rng, 7.0, 14.0)
    branch_ma = motor_ma * float(rng.uniform(0.7, 1.1))
    shared_ma = branch_ma * float(rng.uniform(1.0, 1.6)) if rng.random() < 0.35 else math.inf
    own = np.exp(rng.uniform(math.log(0.8), math.log(1.25), points + beside))
    return Limb(
        largest_nm=log_uniform(rng, 3.0, 15.0),
        wanted=Nerve(wanted_mm, rng.dirichlet(np.full(points, 4.0)), motor_ma * own[:points], branch_ma),
        neighbour=Nerve(neighbour_mm, rng.dirichlet(np.full(beside, 4.0)), motor_ma * own[points:], shared_ma),
        branch_mm=np.array([entry_mm, wanted_mm.mean(axis=0)]),
        spread=float(rng.uniform(0.25, 0.45)),
        power=float(rng.uniform(1.6, 2.4)),
        motor_chronaxie_us=float(rng.uniform(120.0, 250.0)),
        pain_ma=log_uniform(rng, 5.0, 10.0),
        pain_chronaxie_us=float(rng.uniform(350.0, 600.0)),
        pain_power=float(rng.uniform(2.0, 3.5)),
        pain_summation=log_uniform(rng, 1.1, 2.5),
        bumps=np.column_stack([rng.uniform(-40.0, 40.0, (BUMPS, 2)), rng.normal(0.0, 0.25, BUMPS)]),
    )


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))
