"""Anatomy as a prior: muscles under the array as bumps, drawn from a standard normal vector.

Each row of `z` is one possible person. The wanted muscle has two motor points, and two neighbours lie somewhere near.
A source is reached the less, the farther an element lies (a rational quadratic of an ellipse's distance); torque and
spill-over follow what is reached by a Hill curve. A pair splits the current: it reaches the mean of what its elements
reach, times a factor that is learnt.

Assumed, for want of public data: that motor points lie about as far from the array's centre as its elements do; that a
source is felt over 10 to 40 mm; that neighbours lie farther off; how much a session changes (`SESSION`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

OWN = 24
"""Numbers of a person; then as many as `SESSION` for each earlier session."""
SESSION = (4.0, 4.0, 0.2, 0.15)
"""How far an array shifts from session to session (mm, mm), and by how much log gain and log drive change: one sd."""
TAIL = 1.5
"""Power of the fall at a distance: between a Cauchy's and a Gaussian's."""


@dataclass(frozen=True)
class Reach:
    """Which choices, in one session."""

    where_mm: np.ndarray
    """Of the elements, from the array's centre, (elements, 2)."""
    ends: np.ndarray
    """Indices of the two elements of each choice, (choices, 2); of one element twice the same."""
    session: int = 0
    """0 is today; others are earlier."""
    log_charge: float = 0.0
    """Log of this session's charge per pulse over today's."""


@dataclass(frozen=True)
class Fields:
    """What rows of `z` say of choices, each (rows, choices)."""

    torque: np.ndarray
    """In the unit of the search."""
    gain: np.ndarray
    """The wanted muscle's largest torque in that unit, (rows, 1)."""
    slope: np.ndarray
    """By how much torque rises with the log of what is reached."""
    slight: np.ndarray
    """Probability of a spill-over that is slight at least."""
    strong: np.ndarray


def fields(z: np.ndarray, reach: Reach, radius_mm: float) -> Fields:
    """Torque and spill-over of each row at each choice."""
    where = reach.where_mm[None]
    gain, level = np.exp(0.4 + 0.6 * z[:, 0:1]), 0.6 + 1.0 * z[:, 1:2]
    if reach.session:
        own = z[:, OWN + len(SESSION) * (reach.session - 1) :][:, : len(SESSION)] * SESSION
        where = where + own[:, None, :2]
        gain, level = gain * np.exp(own[:, 2:3]), level + own[:, 3:4] + reach.log_charge
    used, ends = np.unique(reach.ends, return_inverse=True)
    reached = _reached(z, where[:, used], radius_mm)[:, :, ends.reshape(reach.ends.shape)]
    pair = reach.ends[:, 0] != reach.ends[:, 1]
    spread = np.where(pair, np.exp(0.2 * z[:, 2:3]), 1.0)
    drive = 0.5 * spread * (reached[..., 0] + reached[..., 1]).transpose(1, 0, 2)
    levels = [level, level + 0.3 * z[:, 3:4], level + 0.6 * z[:, 4:5] - 0.3, level + 0.6 * z[:, 5:6] - 0.3]
    steep = np.exp(1.1 + 0.45 * z[:, 6:7])
    own, second, left, right = _logistic(steep * (np.log(drive) + np.stack(levels)))
    share = 0.5 / (1.0 + np.exp(1.0 - 1.5 * z[:, 7:8]))
    against = 0.5 * np.exp(0.5 * z[:, 8:9])
    torque = gain * ((1.0 - share) * own + share * second - against * left)
    slope = gain * steep * ((1.0 - share) * own * (1.0 - own) + share * second * (1.0 - second))
    spilled = np.log(left + right + 1e-3)
    first = -1.7 + 0.5 * z[:, 9:10]
    return Fields(
        torque, gain, slope,
        _logistic((spilled - first) / 0.25),
        _logistic((spilled - first - np.exp(0.1 + 0.3 * z[:, 10:11])) / 0.25),
    )  # fmt: skip


def _reached(z: np.ndarray, where: np.ndarray, radius_mm: float) -> np.ndarray:
    """How much of each source each element reaches, 1 above it, (rows, sources, elements)."""
    first = 0.65 * radius_mm * z[:, 11:13]
    second = first + 0.8 * radius_mm * z[:, 13:15]
    left, right = 1.4 * radius_mm * z[:, 15:17], 1.4 * radius_mm * z[:, 17:19]
    centre = np.stack([first, second, left, right], axis=1)
    width = 16.0 * np.exp(0.45 * z[:, [19, 19, 20, 21]])
    long = 0.35 * z[:, 22:24]
    size = np.hypot(*long.T) + 1e-9
    same, other = np.cosh(size)[:, None, None], (np.sinh(size) / size)[:, None, None]
    dx, dy = (where[:, None, :, axis] - centre[:, :, None, axis] for axis in (0, 1))
    a, b = long[:, 0, None, None], long[:, 1, None, None]
    far = same * (dx * dx + dy * dy) + other * (a * (dx * dx - dy * dy) + 2.0 * b * dx * dy)
    power = 1.0 + far / (2.0 * TAIL * width[:, :, None] ** 2)
    return 1.0 / (power * np.sqrt(power))


def _logistic(x: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * x)
