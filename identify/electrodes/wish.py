"""What a person wants of an electrode, and one number of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stimrig.identify.errors import BadRequest

WORST_COMFORT, BEST_COMFORT = 0.0, 10.0
SPILLS = ("none", "slight", "strong")


@dataclass(frozen=True)
class Seen:
    """What one stimulus gave: the torque, how far it spilled over (0 none, 1 slight, 2 strong), and its comfort."""

    torque_nm: float
    """Positive is the wanted direction."""
    spill: int  # what else moved
    comfort: float
    """0 unbearable .. 10 unnoticed."""

    def __post_init__(self) -> None:
        for name in ("torque_nm", "spill", "comfort"):
            if not math.isfinite(getattr(self, name)):
                raise BadRequest("a value that is no number", place=name, fix="Repeat the stimulus.")
        if self.spill not in range(len(SPILLS)):
            raise BadRequest(f"there is no spill-over {self.spill}", place="spill", fix="0 none, 1 slight, 2 strong.")
        if not WORST_COMFORT <= self.comfort <= BEST_COMFORT:
            raise BadRequest(f"comfort {self.comfort:g} is not from 0 to 10", place="comfort")


@dataclass(frozen=True)
class Wish:
    """The person's objective: utility is the torque that is left when its prices are paid, N·m.

    utility = min(torque, wanted) × (1 − price of its spill-over) × (comfort / 10) ^ weight of comfort,
    and 0 where comfort is below its limit, where a spill-over costs all, or where torque is below the least that
    counts. So "within 10 % of the best" means a tenth less of a torque that is as pleasant and as selective.
    """

    wanted_nm: float | None = None
    """More torque than this is worth no more; None: the more the better."""
    slight_price: float = 0.25
    """Share of the torque that a slight spill-over costs."""
    strong_price: float = 1.0
    """The same of a strong one; 1 is never acceptable."""
    comfort_weight: float = 0.5  # how much comfort counts
    comfort_limit: float = 4.0
    """A choice that feels worse is out."""
    least_nm: float = 0.1
    """A smaller torque does not move the joint."""

    def __post_init__(self) -> None:
        for name in ("slight_price", "strong_price"):
            if not 0 <= getattr(self, name) <= 1:
                raise BadRequest("a price is a share from 0 to 1", place=name)
        if not (WORST_COMFORT <= self.comfort_limit < BEST_COMFORT and 0 <= self.comfort_weight < math.inf):
            raise BadRequest("a limit from 0 to 10 and a weight not below 0", place="comfort")
        if not (0 < self.least_nm < math.inf and (self.wanted_nm is None or self.wanted_nm > self.least_nm)):
            raise BadRequest("the least torque must be above 0 and below the wanted one", place="least_nm")

    def utility(self, torque_nm: np.ndarray, spill: np.ndarray, comfort: np.ndarray) -> np.ndarray:
        """Utility, N·m; arrays of one shape. 0 is a choice that is out.

        Parameters
        ----------
        torque_nm : ndarray
            What a choice gives, N·m.
        spill : ndarray
            How much of it goes elsewhere.
        comfort : ndarray
            How it felt.

        Returns
        -------
        ndarray
        """
        torque = np.where(np.asarray(torque_nm) < self.least_nm, 0.0, torque_nm)
        torque = np.minimum(torque, self.wanted_nm or np.inf)
        left = 1.0 - np.array([0.0, self.slight_price, self.strong_price])[np.asarray(spill, dtype=int)]
        felt = np.clip(np.asarray(comfort) / BEST_COMFORT, 0.0, 1.0) ** self.comfort_weight
        return np.where(np.asarray(comfort) < self.comfort_limit, 0.0, torque * left * felt)


PRESETS: dict[str, tuple[str, Wish]] = {
    "strong": (
        "The largest torque that is bearable; a strong spill-over is never acceptable.",
        Wish(slight_price=0.05, comfort_weight=0.0, comfort_limit=3.0),
    ),
    "selective": (
        "The wanted muscle alone; a slight spill-over costs more than half.",
        Wish(slight_price=0.6, comfort_weight=0.25, comfort_limit=3.0),
    ),
    "comfortable": (
        "Torque that can be borne for long: what feels bad counts little.",
        Wish(slight_price=0.25, comfort_weight=1.5, comfort_limit=5.0),
    ),
    "balanced": ("Torque, selectivity and comfort, each at a price.", Wish()),
}
"""Wishes by name, each with a sentence."""
