"""An array's elements, and the choices that can be stimulated: single elements and pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stimrig.identify.errors import BadRequest

Elements = tuple[int, ...]
"""A choice: one element, or two in rising order. Elements are numbered from 1."""


@dataclass(frozen=True)
class Layout:
    """Where the elements lie on the skin, mm; the first is element 1. Raises BadRequest: no such array."""

    positions_mm: tuple[tuple[float, float], ...]  # of the elements

    def __post_init__(self) -> None:
        where = np.asarray(self.positions_mm, dtype=float)
        if where.ndim != 2 or where.shape[1] != 2 or len(where) < 2:
            raise BadRequest("a layout needs two elements at least, each with x and y in mm", place="positions_mm")
        if not np.all(np.isfinite(where)):
            bad = int(np.flatnonzero(~np.isfinite(where).all(axis=1))[0]) + 1
            raise BadRequest("a position that is no number", place=f"element {bad}", fix="Give x and y in mm.")
        if len(np.unique(where, axis=0)) < len(where):
            raise BadRequest("two elements lie at the same place", place="positions_mm")

    @property
    def centred_mm(self) -> np.ndarray:
        """Positions from their centre, shape (elements, 2)."""
        where = np.asarray(self.positions_mm, dtype=float)
        return where - where.mean(axis=0)

    @property
    def radius_mm(self) -> float:
        """Root mean square distance of an element from the centre."""
        return float(np.sqrt(np.mean(np.sum(self.centred_mm**2, axis=1))))

    def checked(self, elements: Sequence[int]) -> Elements:
        """The choice with its elements in rising order. Raises BadRequest: an element that is not there.

        Parameters
        ----------
        elements : sequence of int
            Numbers of elements of the array.

        Returns
        -------
        Elements
        """
        chosen = tuple(sorted(elements))
        for element in chosen:
            if isinstance(element, bool) or int(element) != element or not 1 <= element <= len(self.positions_mm):
                fix = f"Elements are numbered from 1 to {len(self.positions_mm)}."
                raise BadRequest(f"there is no element {element}", place="elements", fix=fix)
        if len(set(chosen)) != len(chosen) or len(chosen) not in (1, 2):
            raise BadRequest("a choice is one element or two different ones", place=f"elements {list(elements)}")
        return tuple(int(element) for element in chosen)


def choices(layout: Layout, farthest_mm: float | None = None) -> list[Elements]:
    """All single elements, then all pairs that lie no farther apart than `farthest_mm` (None: all pairs).

    Parameters
    ----------
    layout : Layout
        Of the array.
    farthest_mm : float, optional
        Largest distance of a pair, mm.

    Returns
    -------
    list of Elements
    """
    where = layout.centred_mm
    numbers = range(1, len(where) + 1)
    far = np.inf if farthest_mm is None else farthest_mm * (1 + 1e-9)
    near = [(i, j) for i, j in combinations(numbers, 2) if np.linalg.norm(where[i - 1] - where[j - 1]) <= far]
    return [*((number,) for number in numbers), *near]
