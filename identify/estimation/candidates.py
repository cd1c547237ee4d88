"""Choice of the fitted rows and of the noise model of the plain fit, by the error on left-out blocks.

Likelihood with slow noise is efficient where the structure is right. Where it is wrong, the slow noise takes up what
the structure leaves, and the dynamics follow increments alone. White noise asks for the free run itself; and rows of
the kind that shall be predicted ask for no more than that.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.left_out import bouts, difference, leave_out, near_widths
from stimrig.identify.estimation.rests import relaxed
from stimrig.identify.estimation.solve import Fitted, knows_joint, solve
from stimrig.identify.noise import WHITE, NoiseLevel
from stimrig.identify.records.record import FORGOTTEN_S

Fit = Callable[[np.ndarray, bool], Fitted]
"""A fit of the plain structure to some rows, with noise that is held white or not."""

BETTER = 1.0
"""Standard errors by which a candidate must predict left-out blocks better: otherwise the usual one stays."""
SLOW, SLOW_SHARE = 0.9, 0.05
"""Correlation of neighbours, and share of the variance, from which slow noise of free effects or a moving joint is
distrusted."""
SMOOTH = 0.1
"""Share of the largest width by which pulses follow one another where the width moves smoothly."""
LONG_S = 1.0
"""Stimulation of a bout, s, from which its kind is known."""
LEAST_BOUTS = 3
COVERED = 0.95
"""Share of the rows to be predicted whose widths must be seen in bouts of their kind."""
WHY_WHITE = "slow noise would have taken up what the structure leaves."


def chosen(grid: Grid, rows: np.ndarray, best: Fitted, fit: Fit) -> Fitted:
    """The plain fit with the noise and the rows that predict best.

    `best`: the plain fit to all rows that may be fitted, with slow noise; it stays where nothing speaks against its
    likelihood. `fit`: fits the plain structure to some rows, with noise held white or not.
    """
    if not best.distrusted:
        return best
    similar_rows, unseen = similar_bout_rows(grid, rows), leave_out(best)
    for choice, white in (
        (rows, True),
        *(((similar_rows, False), (similar_rows, True)) if similar_rows is not None else ()),
    ):
        other = fit(choice, white)
        left_out = leave_out(other, np.where(other.problem.setup.fitted, unseen.block, -1))
        if difference(unseen, left_out).errors >= BETTER:
            best, unseen = other, left_out
    return best


def trusted(base: Fitted) -> Fitted:
    """A model of a moving joint or with a free effect, searched again from white noise where slow noise may hold what
    the structure leaves.

    The other optimum is taken where it is the likelier one; else white noise where it predicts left-out blocks better.
    """
    noise = base.noise
    if noise.held or noise.band or min(noise.share, 1.0) < SLOW_SHARE or noise.ar1 < SLOW:
        return base
    if not (any(find_effect(name).shape for name, _ in base.effects) or knows_joint(base)):
        return base
    white = solve(base.problem, base.theta, WHITE)
    refitted = solve(white.problem, white.theta, NoiseLevel(0.0, 0.5, white.noise.sd_nm))
    if refitted.log_evidence > base.log_evidence:
        return refitted
    return white if difference(leave_out(base), leave_out(white)).errors >= BETTER else base


def words(fitted: Fitted, rows: np.ndarray) -> list[str]:
    """Describe the choice and its reason; empty where the noise is usual and all rows were fitted."""
    fitted_rows, sentences = fitted.problem.setup.fitted, []
    if fitted_rows.sum() < rows.sum():
        those = f"the {int(fitted_rows.sum())} in rests and in bouts like `validate`"
        sentences.append(f"Of {int(rows.sum())} pulse intervals, {those} were fitted.")
    if fitted.noise.held and fitted.noise.share == 0.0:
        sentences.append(f"The noise was taken as white: {WHY_WHITE}")
    return [*sentences, *likelihood_warnings(fitted)]


def likelihood_warnings(fitted: Fitted) -> list[str]:
    """What the noise of a fit hides, and why its likelihood is no evidence, in words; nothing where it is."""
    sentences, noise = [], fitted.noise
    if noise.held and noise.share > 0.0:
        zero_nm = noise.sd_nm * noise.share**0.5
        sentences.append(
            f"The noise was taken as white, beside a zero that wanders by {zero_nm:.2g} N·m from rest to rest: "
            f"{WHY_WHITE} The zero is part of the error, and no effect describes it."
        )
    if noise.at_bound:
        sentences.append(
            "The slow noise is as slow as it may be: left-out parts of the record decide, not the likelihood."
        )
    if fitted.heavy_tails:
        kurtosis = f"{fitted.excess_kurtosis:.0f}"
        sentences.append(f"A few jumps hold most of the noise: left-out parts decide (excess kurtosis {kurtosis}).")
    return sentences


def similar_bout_rows(grid: Grid, rows: np.ndarray) -> np.ndarray | None:
    """The rows of bouts like those of `validate`, with all rests, shape (K,); None where there are few, or no others.

    The pulses of `validate` are known; its torque is not looked at.
    """
    if not grid.held_out.any():
        return None
    number = bouts(grid)
    kinds = {bout: _smooth(grid, number == bout) for bout in np.unique(number)}
    wanted = {kinds[bout] for bout in np.unique(number[grid.held_out])} - {None}
    if len(wanted) != 1:
        return None
    similar_bouts = [bout for bout, kind in kinds.items() if kind in wanted and np.any(rows & (number == bout))]
    similar_rows = rows & np.isin(number, similar_bouts)
    predicted = grid.held_out & (grid.pulse_width_us > 0)
    few_or_all = len(similar_bouts) < LEAST_BOUTS or similar_rows.sum() == rows.sum()
    if few_or_all or np.mean(near_widths(grid, similar_rows)[predicted]) < COVERED:
        return None
    return similar_rows | (rows & relaxed(grid, FORGOTTEN_S))


def _smooth(grid: Grid, bout_rows: np.ndarray) -> bool | None:
    """Return True if the width moves smoothly, as in a ramp, False if in jumps; None for a bout too short to tell."""
    widths_us = grid.pulse_width_us[bout_rows]
    steps_us = np.abs(np.diff(widths_us[np.flatnonzero(widths_us)]))
    if steps_us.size * grid.step_s < LONG_S:
        return None
    return bool(np.percentile(steps_us, 95) < SMOOTH * float(np.max(grid.pulse_width_us)))
