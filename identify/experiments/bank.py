"""A bank of earlier models: which of them a muscle is like today, or that it is like none.

Each model of the bank is a hypothesis (Magill 1965): its curve, moved and stretched within what changes from day to
day, with its dynamics. One more hypothesis, `UNLIKE`, is a person who was never seen, with the prior that such a person
has without a bank. All have proper priors, so their evidence can be compared: a hypothesis that says more, and is
right, wins. What is known is the mixture of them all, so a doubt between two is in the bands.

A bank is large and a fit takes time: a fit of the shape alone says which few models are worth a whole one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid, ends_of
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.earlier import EARLIER_DEVIATIONS, USUAL, Change, Earlier
from stimrig.identify.estimation.short_record import Short, direction, fit_short
from stimrig.identify.model import Model
from stimrig.identify.noise import whitened

UNLIKE = "unlike all"
"""Name of the hypothesis that the person is like no model of the bank."""
ALIKE = EARLIER_DEVIATIONS[:2]
"""How far the shape of a curve changes from day to day; what changed more is another curve, and `UNLIKE` is its name.
"""
WHOLE = 2
"""Models that get a whole fit; the others are told to be worse by the fit of the shape."""
BEHIND = 12.0
"""Log evidence of the shape by which a model may be behind the best one, and still gets a whole fit."""
ROUGH = 0.03
"""Error of a shape that was only moved and stretched, as a share of the largest torque seen."""
TURNS, CHANGED = 6, 1e-3
LEAST_WEIGHT = 1e-3
"""A hypothesis of a smaller weight has no draws."""


@dataclass(frozen=True)
class Candidate:
    """A model of the bank: of this person's own, or of somebody else.

    Raises BadRequest: the model is of another kind, or its curve does not rise.
    """

    name: str
    model: Model
    change: Change = USUAL  # by how much such a person changes from day to day

    def __post_init__(self) -> None:
        _ = self.earlier

    @cached_property
    def earlier(self) -> Earlier:
        """As what is known of a person."""
        return Earlier(self.model, self.change, ALIKE)

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviations of log gain, middle (µs), log width, log T and log ζ."""
        mean, precision = self.earlier.dynamics(1.0)
        change = self.change
        curve_sd = [change.gain_log, change.middle_us, change.width_log]
        return np.r_[self.earlier.mean, mean[:2]], np.r_[curve_sd, 1.0 / np.sqrt(np.diag(precision)[:2])]


@dataclass(frozen=True)
class Bank:
    """Models that a person may be like.

    Raises BadRequest: two of one name, or no probability.
    """

    candidates: tuple[Candidate, ...]
    unlike: float = 0.5  # probability, before the test, that the person is like none of them

    def __post_init__(self) -> None:
        names = [one.name for one in self.candidates]
        if len({*names, UNLIKE}) <= len(names):
            raise BadRequest("two models of the same name", place="bank", fix="Give each its own name.")
        if not 0.0 < self.unlike < 1.0:
            raise BadRequest(f"{self.unlike!r} is no probability", place="unlike", fix="Give a number between 0 and 1.")

    @classmethod
    def of(cls, models: Mapping[str, Model], unlike: float = 0.5) -> Bank:
        """Of models by name, each with the usual change from day to day. Models of another kind are left out."""
        found = []
        for name, model in models.items():
            try:
                found.append(Candidate(name, model))
            except BadRequest:
                continue
        return cls(tuple(found), unlike)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, from which `from_dict` makes the bank again."""
        rows = [{"name": c.name, "model": c.model.to_dict(), "change": vars(c.change)} for c in self.candidates]
        return {"unlike": self.unlike, "candidates": rows}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Bank:
        """The bank that `to_dict` wrote. Raises BadModel, BadRequest: a model or the bank is not valid."""
        rows = data["candidates"]
        found = [Candidate(row["name"], Model.from_dict(row["model"]), Change(**row["change"])) for row in rows]
        return cls(tuple(found), data["unlike"])


@dataclass(frozen=True)
class Weighed:
    """What a record says of a bank: some hypotheses with a whole fit each, `UNLIKE` as the last."""

    names: tuple[str, ...]
    weights: np.ndarray  # probabilities, shape (H,)
    fits: tuple[Short, ...] = field(repr=False)
    last: tuple[Earlier | None, ...] = field(repr=False)  # what each knows of the person

    @property
    def likely(self) -> int:
        """Index of the most probable hypothesis."""
        return int(np.argmax(self.weights))

    @property
    def name(self) -> str:
        """The most probable hypothesis."""
        return self.names[self.likely]

    @property
    def is_unlike(self) -> bool:
        """Whether the person is like none."""
        return self.name == UNLIKE

    def to_dict(self) -> dict[str, float]:
        """Probabilities by name."""
        return {name: float(weight) for name, weight in zip(self.names, self.weights, strict=True)}

    def words(self) -> str:
        """One sentence for people."""
        percent = f"{100.0 * self.weights[self.likely]:.0f}"
        return f"Like no earlier model ({percent} %)." if self.is_unlike else f"Like {self.name} ({percent} %)."

    @cached_property
    def mixed(self) -> Short:
        """The fit of the most probable hypothesis, with draws of all, each as often as it is probable."""
        likely = self.fits[self.likely]
        weights = np.where(self.weights >= LEAST_WEIGHT, self.weights, 0.0)
        count = len(likely.dynamics)
        ends = np.round(np.cumsum(weights / weights.sum()) * count).astype(int)
        which = np.searchsorted(ends, np.arange(count), side="right")
        curves, dynamics, others = (
            np.empty_like(one) for one in (likely.coefficients_nm, likely.dynamics, likely.others_nm)
        )
        for number, fit in enumerate(self.fits):
            rows = np.flatnonzero(which == number)
            # A fit's draws are in the order of its kinds of deviation: those that are taken are of all kinds.
            own = np.linspace(0, count - 1, rows.size).round().astype(int)
            if rows.size:
                curves[rows] = fit.coefficients_nm[own] if fit is likely else carried(fit, likely, own)
                dynamics[rows], others[rows] = fit.dynamics[own], fit.others_nm[own]
        strange = float(sum(w * fit.strange for w, fit in zip(weights / weights.sum(), self.fits, strict=True)))
        return replace(likely, coefficients_nm=curves, dynamics=dynamics, others_nm=others, strange=strange)


def carried(fit: Short, to: Short, rows: np.ndarray) -> np.ndarray:
    """Drawn curves of one fit as coefficients of another one's basis, least squares, shape (R, n)."""
    u = np.unique(np.r_[np.linspace(0.0, to.largest_us, 241), to.basis.knots_us])
    values = fit.coefficients_nm[rows] @ fit.basis.design(np.minimum(u, fit.largest_us)).T
    return np.linalg.lstsq(to.basis.design(u), values.T, rcond=None)[0].T


def weigh(grid: Grid, bank: Bank, before: Weighed | None = None) -> Weighed:
    """How probable each hypothesis is, by a record.

    Parameters
    ----------
    grid : Grid
        The record, as `prepare` makes it.
    bank : Bank
        The models.
    before : Weighed, optional
        Of a shorter part of the same record: the fits start there.
    """
    told = rough_evidence(grid, bank.candidates)
    order = sorted(range(told.size), key=lambda i: (-told[i], bank.candidates[i].name))[:WHOLE]
    chosen = [bank.candidates[i] for i in order if told[i] >= told[order[0]] - BEHIND]
    names = (*(one.name for one in chosen), UNLIKE)
    last = (*(one.earlier for one in chosen), None)
    known = {} if before is None else dict(zip(before.names, before.fits, strict=True))
    fits = tuple(
        fit_short(grid, grid.fitted, last=one, before=known.get(name)) for name, one in zip(names, last, strict=True)
    )
    prior = np.r_[np.full(len(chosen), (1.0 - bank.unlike) / max(len(bank.candidates), 1)), bank.unlike]
    found = np.array([evidence(fit) for fit in fits]) + np.log(prior)
    weights = np.exp(found - found.max())
    return Weighed(names, weights / weights.sum(), fits, last)


def evidence(fit: Short) -> float:
    """Log evidence of a fit, over all kinds of deviation of its curve, up to what all fits of a record share."""
    kinds = np.array([mode.log_evidence for mode in fit.modes])
    most = float(kinds.max())
    # Each fit has a noise of its own, whose size its modes leave out: the standard deviation of its innovations counts.
    stretches = ends_of(fit.grid.stretches(fit.rows))
    unit = np.zeros((1, fit.grid.size))
    at = np.flatnonzero(fit.rows)[-1]
    unit[0, at] = 1.0
    innovation_nm = 1.0 / abs(float(whitened(unit, stretches, fit.noise)[0, -1]))
    return most + float(np.log(np.mean(np.exp(kinds - most)))) - float(fit.rows.sum()) * float(np.log(innovation_nm))


# ---- which models are worth a whole fit ----


def rough_evidence(grid: Grid, candidates: Sequence[Candidate]) -> np.ndarray:
    """Log evidence of each candidate's shape, moved and stretched, up to what all share, shape (C,)."""
    rows = grid.fitted
    sign = direction(grid, rows)
    torque = sign * grid.torque_nm
    scale = float(np.percentile(np.abs(torque[rows] - np.median(torque[rows][:8])), 98))
    noise_nm = float(np.hypot(grid.mean_noise_nm(rows), ROUGH * scale))
    return np.array([_Shape(grid, rows, torque, noise_nm, one).evidence() for one in candidates])


class _Shape:
    """One candidate's curve with five unknowns: standard deviates of its prior."""

    def __init__(
        self, grid: Grid, rows: np.ndarray, torque_nm: np.ndarray, noise_nm: float, candidate: Candidate
    ) -> None:
        self.grid, self.rows, self.candidate, self.noise_nm = grid, rows, candidate, noise_nm
        self.torque_nm = torque_nm[rows]
        self.mean, self.sd = candidate.prior

    def residual(self, z: np.ndarray) -> np.ndarray:
        """In standard deviations of the noise, without a zero, which is free."""
        gain, middle, width, slow, damping = self.mean + self.sd * z
        shape, scale = self.candidate.earlier.shape, np.exp(width)
        value, zero = (shape((u - middle) / scale)[0] for u in (self.grid.pulse_width_us, np.zeros(1)))
        linear = SecondOrder(float(np.exp(slow)), float(np.exp(damping))).bounded(self.grid.delay_bounds_s)
        torque = linear.on_grid(self.grid, np.exp(gain) * (value - zero))[self.rows]
        left = self.torque_nm - torque
        return (left - left.mean()) / self.noise_nm

    def evidence(self) -> float:
        """By Laplace's approximation."""
        z = np.zeros(5)
        now = self.residual(z)
        information = np.eye(5)
        for _ in range(TURNS):
            slopes = np.stack([(self.residual(z + CHANGED * one) - now) / CHANGED for one in np.eye(5)])
            information = slopes @ slopes.T + np.eye(5)
            step = np.linalg.solve(information, -slopes @ now - z)
            z, now = self._stepped(z, now, step)
        return float(-0.5 * (now @ now + z @ z) - 0.5 * np.linalg.slogdet(information)[1])

    def _stepped(self, z: np.ndarray, now: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The step, halved until it is no worse."""
        for share in (1.0, 0.5, 0.25, 0.1):
            moved = np.clip(z + share * step, -8.0, 8.0)
            left = self.residual(moved)
            if left @ left + moved @ moved <= now @ now + z @ z:
                return moved, left
        return z, now
