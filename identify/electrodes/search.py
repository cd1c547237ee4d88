"""The search: which choice next, when to stop, and the map so far."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stimrig.identify.electrodes.anatomy import Reach
from stimrig.identify.electrodes.layout import Elements, Layout, choices
from stimrig.identify.electrodes.posterior import Believed, Evidence
from stimrig.identify.electrodes.wish import Seen, Wish
from stimrig.identify.errors import BadRequest

NEAR, FAR = 0.9, 0.8
"""A choice is as good as the best above the first share of its utility, and wrong below the second."""
SURE = 0.95
"""Probability not to be wrong that is enough to stop; chosen on emulated people that are not those of the bench."""
NONE_SURE = 0.95
"""Probability that no choice is of use that is enough to stop."""
MOST = 20
"""Stimuli of one search."""
USUAL = 10.0
"""A muscle's usual torque, in parts of the least that counts: assumed until more is seen."""
QUANTITIES = ("torque_nm", "spill", "comfort", "utility")
SCHEMA = 1


@dataclass(frozen=True)
class Proposal:
    """The next choice to stimulate."""

    elements: Elements  # the choice to try
    why: str  # in words
    expected: float
    """Utility, N·m."""
    sd: float  # of what is expected


@dataclass(frozen=True)
class Stop:
    """Why no further stimulus is worth it. `elements` is None where no element moves the joint."""

    reason: str  # in words
    elements: Elements | None  # the best choice
    probability: float
    """That the best known choice is within 10 % of the best; or that no choice is of use."""


class Search:
    """A search over an array's choices at one pulse width and current.

    `prior`: an earlier `Search` of the same person, or its dict. `farthest_mm`: pairs farther apart are left out.
    """

    def __init__(
        self, layout: Layout, wish: Wish, width_us: float, current_ma: float,
        prior: Search | Mapping[str, Any] | None = None, *, farthest_mm: float | None = None,
    ) -> None:  # fmt: skip
        if not (0 < width_us < np.inf and 0 < current_ma < np.inf):
            raise BadRequest("pulse width and current must be above 0", place="width_us, current_ma")
        self.layout, self.wish, self.width_us, self.current_ma = layout, wish, float(width_us), float(current_ma)
        self.farthest_mm = farthest_mm
        self.prior = Search.from_dict(prior) if isinstance(prior, Mapping) else prior
        self.choices = choices(layout, farthest_mm)
        self.seen: list[tuple[Elements, Seen]] = []

    def add(self, elements: Sequence[int], seen: Seen) -> None:
        """Keep what a stimulus gave. Raises BadRequest: elements that are not there.

        Parameters
        ----------
        elements : sequence of int
            Numbers of those that were stimulated.
        seen : Seen
            What came of it.
        """
        self.seen.append((self._known(elements), seen))
        self.__dict__.pop("_draws", None)

    def _known(self, elements: Sequence[int]) -> Elements:
        chosen = self.layout.checked(elements)
        if chosen not in self.choices:
            raise BadRequest("these elements lie too far apart to be a choice", place=f"elements {list(chosen)}")
        return chosen

    def _sessions(self) -> list[Search]:
        """Today's and the earlier ones, the latest first."""
        return [self, *(self.prior._sessions() if self.prior else [])]

    def _unit_nm(self) -> float:
        """Torque is counted in parts of the largest that was seen, so that its scale does not matter."""
        seen = [abs(each.torque_nm) for one in self._sessions() for _, each in one.seen]
        return max([USUAL * self.wish.least_nm, *seen])

    def _reach(self, session: int, some: Sequence[Elements], charge: float) -> Reach:
        ends = np.array([(each[0] - 1, each[-1] - 1) for each in some], dtype=int).reshape(-1, 2)
        own = self.width_us * self.current_ma
        return Reach(self.layout.centred_mm, ends, session, float(np.log(own / charge)))

    @cached_property
    def _draws(self) -> dict[str, np.ndarray]:
        """Draws of each quantity, (draws, choices)."""
        unit, charge, evidence = self._unit_nm(), self.width_us * self.current_ma, []
        for session, one in enumerate(self._sessions()):
            reach = one._reach(session, [elements for elements, _ in one.seen], charge)
            rows = np.array([(each.torque_nm / unit, each.spill, each.comfort) for _, each in one.seen]).reshape(-1, 3)
            evidence.append(Evidence(reach, *rows.T))
        today = self._reach(0, self.choices, charge)
        drawn = Believed(evidence, today, self.layout.radius_mm, seed=len(self.seen)).draws()
        torque = drawn.torque * unit
        utility = self.wish.utility(torque, drawn.spill, drawn.comfort)
        return {"torque_nm": torque, "spill": drawn.spill, "comfort": drawn.comfort, "utility": utility}

    def _best_index(self) -> int | None:
        """Of the stimulated choices, the one of the largest expected utility."""
        mean = self._draws["utility"].mean(axis=0)
        tried = sorted({self.choices.index(elements) for elements, _ in self.seen})
        best = max(tried, key=lambda at: mean[at], default=None)
        return None if best is None or np.mean(self._draws["utility"][:, best] > 0) < 0.5 else best

    def best(self) -> Elements | None:
        """The best choice of those that were stimulated; None while none is of use.

        Returns
        -------
        Elements or None
        """
        at = self._best_index()
        return None if at is None else self.choices[at]

    def sure(self) -> float | None:
        """Probability that the best known choice is within 10 % of the best; None while none is of use.

        Returns
        -------
        float or None
        """
        utility, at = self._draws["utility"], self._best_index()
        return None if at is None else float(np.mean(utility[:, at] >= NEAR * utility.max(axis=1)))

    def next(self, left_out: Collection[Elements] = ()) -> Proposal:
        """The choice from which most is to be gained: the largest expected improvement (Jones et al. 1998).

        `left_out`: choices that are not to be proposed.

        Parameters
        ----------
        left_out : collection of Elements
            Choices that are not proposed.

        Returns
        -------
        Proposal
        """
        utility, at = self._draws["utility"], self._best_index()
        known = np.zeros((len(utility), 1)) if at is None else utility[:, [at]]
        gain, mean = np.maximum(utility - known, 0.0).mean(axis=0), utility.mean(axis=0)
        out = [place for place, elements in enumerate(self.choices) if elements in left_out]
        if len(out) < len(self.choices):
            gain[out], mean[out] = -1.0, -1.0
        picked = int(np.argmax(gain)) if np.any(gain > 0.0) else int(np.argmax(mean))
        elements, mean, sd = self.choices[picked], float(utility[:, picked].mean()), float(utility[:, picked].std())
        better = float(np.mean(utility[:, picked] > known[:, 0]))
        return Proposal(elements, self._why(elements, at, better), mean, sd)

    def _why(self, elements: Elements, at: int | None, better: float) -> str:
        if at is None:
            return f"{_name(elements)}: nothing of use is known yet; probability {better:.0%} that this is."
        name, best = _name(elements), _name(self.choices[at]).lower()
        if any(elements == each for each, _ in self.seen):
            return f"{name} once more: probability {better:.0%} to beat {best}."
        return f"{name}: probability {better:.0%} to beat {best}."

    def enough(self) -> Stop | None:
        """Whether to stop, and why; None: go on.

        Returns
        -------
        Stop or None
        """
        utility, at = self._draws["utility"], self._best_index()
        top = utility.max(axis=1)
        if at is None:
            return self._none_of_use(float(np.mean(top <= 0.0)))
        best, near = utility[:, at], float(np.mean(utility[:, at] >= NEAR * top))
        right = float(np.mean(best >= FAR * top))
        name = _name(self.choices[at])
        if right >= SURE:
            return Stop(f"{name}: probability {near:.0%} to be within 10 % of the best.", self.choices[at], near)
        if len(self.seen) >= MOST:
            reason = f"{len(self.seen)} stimuli are enough. {name} is the best so far; a better one may be left."
            return Stop(reason, self.choices[at], near)
        return None

    def _none_of_use(self, nothing: float) -> Stop | None:
        """Where no choice that was stimulated is of use, and `nothing` is the probability that none is."""
        if nothing < NONE_SURE and len(self.seen) < MOST:
            return None
        still = float(np.mean(self._draws["torque_nm"].max(axis=1) < self.wish.least_nm))
        if max(each.torque_nm for _, each in self.seen) < self.wish.least_nm and still >= 0.5:
            return Stop("No element moves the joint. Try more current, or another place.", None, nothing)
        reason = "No element that was tried gives what is wished: each spills over, hurts, or gives no torque."
        return Stop(reason, None, nothing)

    def map(self) -> list[dict[str, Any]]:
        """For each choice its elements, whether it was stimulated, and mean and sd of each quantity.

        Returns
        -------
        list of dict
        """
        done = {elements for elements, _ in self.seen}
        rows = [{"elements": list(each), "stimulated": each in done} for each in self.choices]
        for name in QUANTITIES:
            for row, mean, sd in zip(rows, self._draws[name].mean(axis=0), self._draws[name].std(axis=0), strict=True):
                row[name] = {"mean": float(mean), "sd": float(sd)}
        return rows

    def to_dict(self) -> dict[str, Any]:
        """All that the search is, as JSON holds it.

        Returns
        -------
        dict
        """
        return {
            "schema_version": SCHEMA,
            "positions_mm": [list(map(float, each)) for each in self.layout.positions_mm],
            "farthest_mm": self.farthest_mm,
            "wish": asdict(self.wish),
            "width_us": self.width_us,
            "current_ma": self.current_ma,
            "seen": [{"elements": list(elements), **asdict(each)} for elements, each in self.seen],
            "prior": self.prior.to_dict() if self.prior else None,
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> Search:
        """The search that `to_dict` wrote. Raises BadRequest: not such a dict.

        Parameters
        ----------
        kept : mapping
            What `to_dict` gave.

        Returns
        -------
        Search
        """
        try:
            layout = Layout(tuple((float(x), float(y)) for x, y in kept["positions_mm"]))
            made = cls(layout, Wish(**kept["wish"]), kept["width_us"], kept["current_ma"], kept["prior"],
                       farthest_mm=kept["farthest_mm"])  # fmt: skip
            for each in kept["seen"]:
                made.add(each["elements"], Seen(each["torque_nm"], each["spill"], each["comfort"]))
        except (KeyError, TypeError, ValueError) as error:
            raise BadRequest(f"not a search that was kept ({error})", place="electrodes") from error
        return made


def _name(elements: Elements) -> str:
    return f"Element {elements[0]}" if len(elements) == 1 else f"Elements {elements[0]} and {elements[1]}"
