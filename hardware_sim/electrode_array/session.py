"""An array on a limb, drawn by a seed, and a session with it: what each choice does, and what is seen of it.

The array has 4 x 4 elements, or 4 x 6 or 6 x 4, U(10, 14) mm apart, numbered from 1 along its rows (a row runs along
the limb). Somebody has put it on: its middle is N(0, 5) mm from the muscle's, turned by N(0, 5) degrees. The return
electrode is fixed, elsewhere.

Each session puts it on again and finds another day (N: normal): moved by N(0, 3) mm in each direction and N(0, 3)
degrees from where the person's array usually sits; torque × exp N(0, 0.1), motor thresholds × exp N(0, 0.07), pain
threshold × exp N(0, 0.12). Within it the skin creeps with each stimulus by N(0, 0.05) mm, in steps that add up, and
slips at each by N(0, 0.2) mm for that stimulus alone. `truth` is that of the skin where it has crept to, without the
slip. Nothing tires.

Of a stimulus (a train of about a second) is seen:

- the torque with an error of N(0, 0.08 N·m) and N(0, 4 %);
- spill-over as a clinician sees it, 0 none, 1 slight, 2 strong: recruited share of the neighbour + N(0, 0.04), from
  0.08 and from 0.35;
- comfort as the person says it, a whole number from 0 (unbearable) to 10 (nothing felt): 10 − pain, shifted by the
  session's mood of N(0, 0.4), + N(0, 0.6), rounded.

ASSUMED, for want of public data: all these numbers; that places, gain and thresholds are independent between days.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stimrig.hardware_sim.electrode_array.limb import Floats, Limb, Response, draw_limb
from stimrig.hardware_sim.hidden.scenario import rng_of

SIZES = {16: ((4, 4),), 24: ((4, 6), (6, 4))}
"""Rows and columns."""
SLIGHT, STRONG = 0.08, 0.35
DAILY_MM, DAILY_DEG, CREEP_MM, SLIP_MM = 3.0, 3.0, 0.05, 0.2
LARGEST_US, LARGEST_MA = 300.0, 40.0
"""Of the charges with which a drawn limb must give some torque."""

Choice = tuple[int, ...]


@dataclass(frozen=True)
class Truth:
    """What a stimulus does: steady torque of the wanted muscle, recruited share of the neighbour, pain 0 to 10."""

    torque_nm: float
    spill: float
    pain: float


@dataclass(frozen=True)
class Seen:
    """What an experimenter learns of it: spill-over 0 none, 1 slight, 2 strong; comfort 10 (best) to 0."""

    torque_nm: float
    spill: int
    comfort: int


@dataclass(frozen=True)
class Best:
    """The choice and charge with the largest utility."""

    elements: Choice
    width_us: float
    current_ma: float
    truth: Truth
    utility: float


@dataclass(frozen=True, eq=False)
class ElectrodeArray:
    """An array as it usually sits on a person's limb."""

    seed: int
    rows: int
    columns: int
    pitch_mm: float
    middle_mm: tuple[float, float]
    turned_deg: float
    limb: Limb

    @property
    def elements(self) -> int:
        """How many it has."""
        return self.rows * self.columns

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """All single elements, then all pairs."""
        numbers = range(1, self.elements + 1)
        return (*((one,) for one in numbers), *itertools.combinations(numbers, 2))

    @cached_property
    def grid_mm(self) -> Floats:
        """Places of the elements on the array about its middle, x along the limb and y, shape (elements, 2)."""
        y, x = np.divmod(np.arange(self.elements), self.columns)
        return self.pitch_mm * np.column_stack([x - (self.columns - 1) / 2, y - (self.rows - 1) / 2])

    def places_mm(self, moved_mm: Floats | Sequence[float] = (0.0, 0.0), turned_deg: float = 0.0) -> Floats:
        """Places of the elements on the limb, the array moved and turned from where it usually sits."""
        angle = math.radians(self.turned_deg + turned_deg)
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        return self.grid_mm @ turn + self.middle_mm + np.asarray(moved_mm)

    def session(self, number: int) -> Session:
        """The session of this number, from its beginning."""
        return Session(self, number)


def draw_array(seed: int, elements: int = 16) -> ElectrodeArray:
    """The array and the limb that `seed` draws.

    Raises
    ------
    ValueError
        Neither 16 nor 24 elements.
    """
    if elements not in SIZES:
        raise ValueError(f"an array of {elements} elements: there are {', '.join(map(str, SIZES))}")
    rng = rng_of(seed, "electrode array", str(elements))
    rows, columns = SIZES[elements][int(rng.integers(len(SIZES[elements])))]
    pitch_mm, turned_deg = float(rng.uniform(10.0, 14.0)), float(rng.normal(0.0, 5.0))
    middle_mm = float(rng.normal(0.0, 5.0)), float(rng.normal(0.0, 5.0))
    while True:
        array = ElectrodeArray(seed, rows, columns, pitch_mm, middle_mm, turned_deg, draw_limb(rng))
        currents_ma = np.arange(1.0, LARGEST_MA + 1.0)
        each, places = np.eye(elements), array.places_mm()
        reached = [array.limb.respond(places, each, LARGEST_US, current) for current in currents_ma.tolist()]
        if any(np.any((one.torque_nm >= 0.3 * array.limb.largest_nm) & (one.pain <= 4.0)) for one in reached):
            return array


class Session:
    """An array on one day. Its own random numbers follow from the seed, its number and the stimuli before."""

    def __init__(self, array: ElectrodeArray, number: int) -> None:
        self.array, self.number = array, number
        self._rng = rng = rng_of(array.seed, "electrode array, session", str(array.elements), str(number))
        self._moved_mm, self._turned_deg = rng.normal(0.0, DAILY_MM, 2), float(rng.normal(0.0, DAILY_DEG))
        gain, motor, pain = np.exp(rng.normal(0.0, [0.1, 0.07, 0.12])).tolist()
        self._mood = float(rng.normal(0.0, 0.4))
        limb = array.limb
        wanted, neighbour = (
            replace(nerve, thresholds_ma=motor * nerve.thresholds_ma, branch_ma=motor * nerve.branch_ma)
            for nerve in (limb.wanted, limb.neighbour)
        )
        scaled = {"largest_nm": gain * limb.largest_nm, "pain_ma": pain * limb.pain_ma}
        self.limb = replace(limb, wanted=wanted, neighbour=neighbour, **scaled)

    @property
    def moved_mm(self) -> tuple[float, float]:
        """How far the array now sits from its usual place, along the limb and across."""
        return float(self._moved_mm[0]), float(self._moved_mm[1])

    def stimulate(self, elements: Choice, width_us: float, current_ma: float) -> Seen:
        """Stimulate for a second through these elements, which share the current, and look.

        Raises
        ------
        ValueError
            No element, one that the array does not have, or one twice; a width or current that is not above zero.
        """
        rng = self._rng
        slip_mm = rng.normal(0.0, SLIP_MM, 2)
        true = self._respond(elements, width_us, current_ma, self._moved_mm + slip_mm)
        self._moved_mm = self._moved_mm + rng.normal(0.0, CREEP_MM, 2)
        torque_nm = true.torque_nm * (1.0 + float(rng.normal(0.0, 0.04))) + float(rng.normal(0.0, 0.08))
        spill = true.spill + float(rng.normal(0.0, 0.04))
        comfort = 10.0 - true.pain + self._mood + float(rng.normal(0.0, 0.6))
        return Seen(torque_nm, (spill >= SLIGHT) + (spill >= STRONG), round(min(max(comfort, 0.0), 10.0)))

    def truth(self, elements: Choice, width_us: float, current_ma: float) -> Truth:
        """What these elements do with the skin where it is now; raises as `stimulate`."""
        return self._respond(elements, width_us, current_ma, self._moved_mm)

    def field(self, width_us: float, current_ma: float) -> Response:
        """The truth of all the array's choices at one charge, each of shape (choices,)."""
        places_mm = self.array.places_mm(self._moved_mm, self._turned_deg)
        return self.limb.respond(places_mm, self._all_shares, width_us, current_ma)

    def best(
        self,
        utility: Callable[[Floats, Floats, Floats], Floats],
        widths_us: Sequence[float],
        currents_ma: Sequence[float],
    ) -> Best:
        """Of all choices and these charges the one with the largest `utility(torque_nm, spill, pain)`.

        `utility` takes and gives arrays, one number for each choice.
        """
        found: list[Best] = []
        for width_us, current_ma in itertools.product(widths_us, currents_ma):
            response = self.field(width_us, current_ma)
            values = utility(*response)
            k = int(np.argmax(values))
            truth = Truth(*(float(column[k]) for column in response))
            found.append(Best(self.array.choices[k], width_us, current_ma, truth, float(values[k])))
        return max(found, key=lambda one: one.utility)

    @cached_property
    def _all_shares(self) -> Floats:
        return np.stack([self._shares(choice) for choice in self.array.choices])

    def _shares(self, elements: Choice) -> Floats:
        shares = np.zeros(self.array.elements)
        if not elements or len(set(elements)) < len(elements):
            raise ValueError(f"elements {elements}: give each once, and at least one")
        for element in elements:
            if not 1 <= element <= self.array.elements:
                raise ValueError(f"element {element}: the array has 1 to {self.array.elements}")
            shares[element - 1] = 1.0 / len(elements)
        return shares

    def _respond(self, elements: Choice, width_us: float, current_ma: float, moved_mm: Floats) -> Truth:
        if not (0.0 < width_us < math.inf and 0.0 < current_ma < math.inf):
            raise ValueError(f"{width_us:g} µs, {current_ma:g} mA: both must be above zero")
        places_mm = self.array.places_mm(moved_mm, self._turned_deg)
        response = self.limb.respond(places_mm, self._shares(elements)[None], width_us, current_ma)
        return Truth(*(float(column[0]) for column in response))
