"""Left-out blocks: what a model predicts, in free run, on parts of its record that its fit has not seen.

Likelihood takes a candidate for true: on thousands of correlated rows a wrong but flexible equation wins. The error on
blocks that are left out asks less: whether the candidate predicts better (Vehtari, Gelman and Gabry 2017 on the
difference and its standard error; Roberts and others 2017 on blocks in place of rows).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.rests import relaxed
from stimrig.identify.estimation.solve import Fitted, Point, log_posterior, newton_step, once, solve
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import FORGOTTEN_S

APART_S = 1.0
"""A pause that separates two bouts of stimulation; the zeros of a PRBS are shorter."""
PIECES, LEAST_S = 10, 2.0
"""A block has about this part of the rows at most, unless that is less than so many seconds."""
MAX_BOUTS = 2 * PIECES
"""Neighbours are joined if there are more bouts: each block is a fit."""
START_S = 0.3
"""Rows after a start that stay in the fit: only they show the state in which the record begins."""
NEAR = 0.02
"""A width farther than this (share of the largest) from every width of the fit lies on a guessed part of the curve."""
LEAST_ROWS = 20
"""A block with fewer rows to judge by is not counted."""
SHORTER = (1.0, 0.5)
TRUSTED = 0.25
"""A step, or its half, is trusted where it gains this share of the predicted gain; else the search makes STEPS
steps."""
STEPS = 4
RIDGE = 1e-9
"""Share added to the curvature of each parameter, for parameters that only the left-out block determines."""
ZERO_SD = 2.0
"""Number of standard deviations of the zero at rest within which the mean error of a block may be its zero."""
LEAST_WEIGHT = 0.01
"""Weight of a block in which both models err no more than white noise."""
LEAST_BLOCKS = 1.5
"""Number of effective blocks below which nothing is concluded."""
MOVED_RAD = 0.05
"""A joint that moves by more at rest is not held."""
SLACK = 0.05
"""Log posterior by which a step may gain less than predicted."""
FLOOR_SHARE = 0.0015
"""Share of the largest torque below which an error does not matter."""


def bouts(grid: Grid) -> np.ndarray:
    """The number of the bout of stimulation that each interval belongs to, with the rest after it, shape (K,)."""
    at = np.flatnonzero(grid.pulse_width_us > 0)
    later = at[1:][np.diff(at) > APART_S / grid.step_s]
    turns = np.flatnonzero(np.diff(grid.held_out)) + 1
    return np.searchsorted(np.unique(np.r_[later, turns, grid.begins]), np.arange(grid.size), side="right")


def blocks(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """The number of each interval's block, shape (K,); -1 where `rows` is false.

    Whole bouts; long ones are cut into pieces of about equal numbers of rows, and of very many neighbours are joined.
    They depend on the pulses alone, so that all models of a record share them.
    """
    ends, count = np.r_[np.flatnonzero(np.diff(bouts(grid))) + 1, grid.size], np.r_[0, np.cumsum(rows)]
    piece, edges = max(count[-1] / PIECES, LEAST_S / grid.step_s), [0]
    min_rows = 0.5 * piece if ends.size > MAX_BOUTS else 0.0
    for end in ends.tolist():
        if count[end] - count[edges[-1]] >= min_rows:
            edges.append(end)
    edges = [*edges[: max(len(edges) - 1, 1)], grid.size]  # a short rest of the record belongs to the last block
    borders = [np.array(edges)]
    for start, stop in pairwise(edges):
        pieces = max(round((count[stop] - count[start]) / piece), 1)
        inner = count[start] + (count[stop] - count[start]) * np.arange(1, pieces) / pieces
        borders.append(np.searchsorted(count, inner))
    edges = np.unique(np.concatenate(borders))
    return np.where(rows, np.searchsorted(edges, np.arange(grid.size), side="right"), -1)


def near_widths(grid: Grid, rows: np.ndarray) -> np.ndarray:
    """bool, shape (K,): intervals whose width, and all within the muscle's memory before, are near those of `rows`."""
    widths = np.unique(grid.pulse_width_us[rows])
    if widths.size < 2:
        return np.zeros(grid.size, bool)
    after = np.clip(np.searchsorted(widths, grid.pulse_width_us), 1, widths.size - 1)
    away = np.minimum(np.abs(grid.pulse_width_us - widths[after]), np.abs(grid.pulse_width_us - widths[after - 1]))
    memory = np.ones(round(FORGOTTEN_S / grid.step_s))
    return np.convolve(away > NEAR * float(widths[-1]), memory)[: grid.size] < 0.5


@dataclass(frozen=True)
class LeftOut:
    """Errors of a model's predictions on left-out blocks."""

    error_nm: np.ndarray
    """Shape (K,); measured minus predicted where the block of the interval was left out, N·m; NaN where nothing can be
    judged."""
    block: np.ndarray  # shape (K,); as `blocks` gives it
    floor_nm: float  # error below which a difference does not matter: that of white noise, N·m
    wander_nm: float = 0.0
    """Scatter of the torque at rest. A block's mean error is no fault of the model as far as its zero explains it."""

    def square(self, rows: np.ndarray) -> float:
        """Mean square error of some intervals of one block about their zero, N²m²."""
        error_nm = self.error_nm[rows]
        zero_nm = np.clip(error_nm.mean(), -ZERO_SD * self.wander_nm, ZERO_SD * self.wander_nm)
        return float(np.mean((error_nm - zero_nm) ** 2))

    @cached_property
    def rms_nm(self) -> float:
        """Over all blocks, N·m; NaN if none can be judged."""
        known = self.error_nm[np.isfinite(self.error_nm)]
        return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def leave_out(fitted: Fitted, block: np.ndarray | None = None) -> LeftOut:
    """The free-run error of a model on each block of its fitted rows, with all parameters found without that block.

    The noise is that of the whole fit. Rows are judged where their widths were seen in the rest of the record.

    `fitted`: the model. `block`: shape (K,); the block of each interval, -1 for none; as `blocks` gives it by default.
    """
    return _left_out(fitted) if block is None else _without(fitted, block)


@once  # whoever trusts a model and whoever adds it ask the same
def _left_out(fitted: Fitted) -> LeftOut:
    setup = fitted.problem.setup
    return _without(fitted, blocks(setup.grid, setup.fitted))


def _without(fitted: Fitted, block: np.ndarray) -> LeftOut:
    setup = fitted.problem.setup
    grid = setup.grid
    opening = np.zeros(grid.size, bool)
    for start in grid.starts:
        opening[start : start + round(START_S / grid.step_s)] = True
    error = np.full(grid.size, np.nan)
    sporadic = _sporadic(fitted)
    for number in np.unique(block[block >= 0]):
        out = (block == number) & ~opening
        remaining = setup.fitted & ~out
        judged = out & near_widths(grid, remaining)
        if judged.sum() < LEAST_ROWS:
            continue
        theta = _refitted(fitted, remaining)
        error[judged] = (setup.target_nm - fitted.problem.run(theta, skip=sporadic)[0])[judged]
    return LeftOut(error, block, *_allowed_nm(fitted))


def hold_out(fitted: Fitted) -> LeftOut:
    """The same on rows of `validate`, which no fit has seen, in pieces of `LEAST_S`."""
    setup = fitted.problem.setup
    grid = setup.grid
    rows = grid.held_out & ~grid.doubted & (2 * grid.count >= np.median(grid.count[setup.fitted]))
    judged = rows & near_widths(grid, setup.fitted)
    mean = fitted.problem.run(fitted.theta, skip=_sporadic(fitted))[0]
    piece = np.cumsum(rows) // max(round(LEAST_S / grid.step_s), 1)
    error = np.where(judged, setup.target_nm - mean, np.nan)
    return LeftOut(error, np.where(rows, piece, -1), *_allowed_nm(fitted))


def _sporadic(fitted: Fitted) -> frozenset[str]:
    """Effects that nothing foretells: a block that is left out shows none of them."""
    return frozenset(effect for effect, _ in fitted.effects if find_effect(effect).sporadic)


def _allowed_nm(fitted: Fitted) -> tuple[float, float]:
    """Error that does not matter, and scatter of the torque at rest, N·m."""
    setup = fitted.problem.setup
    grid = setup.grid
    rest = setup.fitted & relaxed(grid, FORGOTTEN_S)
    still, part = setup.target_nm[rest], grid.part[rest]
    for number in np.unique(part):  # each part has its own zero
        still[part == number] -= np.median(still[part == number])
    wander = 1.4826 * float(np.median(np.abs(still))) if still.size else 0.0
    if grid.angle_rad is not None and still.size and np.ptp(grid.angle_rad[rest]) > MOVED_RAD:
        wander = 0.0  # a joint that moves has its passive torque at rest
    return max(grid.mean_noise_nm(setup.fitted), FLOOR_SHARE * setup.scale_nm), wander


def _refitted(fitted: Fitted, remaining: np.ndarray) -> np.ndarray:
    """The most probable parameters on some of the fitted rows: one Gauss-Newton step, or more where it is too long."""
    problem, setup = fitted.problem, fitted.problem.setup
    reduced = Problem(setup.with_(fitted=remaining), fitted.effects)
    before = log_posterior(reduced, fitted.theta, fitted.residual_nm, fitted.noise)
    at = Point(reduced, fitted.theta, fitted.residual_nm, fitted.slopes, fitted.noise, before, before)
    step = newton_step(at, RIDGE)[0]
    for factor in SHORTER:
        theta = np.clip(fitted.theta + factor * step, problem.lower, problem.upper)
        gained = log_posterior(reduced, theta, setup.target_nm - problem.run(theta)[0], fitted.noise) - before
        if gained >= TRUSTED * factor * 0.5 * float(at.gradient @ step) - 0.5 * SLACK:
            return theta
    return solve(reduced, fitted.theta, fitted.noise, max_steps=STEPS, profiled=False).theta


@dataclass(frozen=True)
class Difference:
    """Difference between two models in the error on left-out blocks."""

    gain: float
    """Mean over rows of the logarithm of the ratio of their blocks' errors; above 0: the second model is better."""
    sd: float  # its standard error over blocks
    blocks: float  # effective number of blocks

    @property
    def errors(self) -> float:
        """The gain in standard errors; 0 where there is hardly more than one effective block."""
        return self.gain / max(self.sd, 1e-9) if self.blocks > LEAST_BLOCKS else 0.0

    @property
    def change(self) -> str:
        """In which direction the error changes, by how much, and in how many standard errors."""
        change, errors = 100.0 * abs(1.0 - np.exp(-self.gain)), abs(self.errors)
        # not "rises by 0 %: it must not rise"
        percent = f"{change:.0f}" if change >= 0.5 else f"{change:.2f}" if change >= 0.01 else "less than 0.01"
        return f"{'rises' if self.gain < 0.0 else 'falls'} by {percent} % ({errors:.1f} standard errors)"

    @property
    def words(self) -> str:
        """Change of the error on left-out parts, as a sentence."""
        return f"On parts left out of the fit the error {self.change}."

    @property
    def words_of_choice(self) -> str:
        """The same of a form that was chosen among many by just this error."""
        return f"{self.words} It was chosen among many by these parts: on pulses of another kind it may gain less."


def from_to(before_nm: float, after_nm: float) -> str:
    """Say in which direction an error changes, and between which values."""
    before, after = f"{before_nm:.3g}", f"{after_nm:.3g}"
    if before == after:
        return f"stays at {after} N·m"
    return f"{'rises' if after_nm > before_nm else 'falls'} from {before} to {after} N·m"


def difference(before: LeftOut, after: LeftOut) -> Difference:
    """Compare two models of one record, block by block of the second.

    Each row weighs as the share of its block's larger error that is not white noise: a block in which both err by no
    more has hardly any weight.
    """
    pairs, noise = [], before.floor_nm**2
    for number in np.unique(after.block[after.block >= 0]):
        in_block = (after.block == number) & np.isfinite(before.error_nm) & np.isfinite(after.error_nm)
        if in_block.any():
            pairs.append((before.square(in_block), after.square(in_block), in_block.sum()))
    if not pairs:
        return Difference(0.0, float("inf"), 0.0)
    old, new, rows = np.array(pairs).T
    weight = rows * np.maximum(1.0 - noise / np.maximum(np.maximum(old, new), 1e-300), LEAST_WEIGHT)
    ratio = 0.5 * np.log((old + noise) / (new + noise))
    gain = float(weight @ ratio / weight.sum())
    effective_blocks = float(weight.sum() ** 2 / (weight @ weight))
    sd = float(np.sqrt(np.sum((weight * (ratio - gain)) ** 2)) / weight.sum())
    return Difference(gain, sd * np.sqrt(effective_blocks / max(effective_blocks - 1.0, 1e-9)), effective_blocks)
