"""A set of effects around f and G as a function of its parameters: simulation and its derivatives.

The signal passes stages in a fixed order. A derivative is found by perturbing a parameter at its own stage and letting
the perturbed signal run through the rest beside the others, as one more row of the same arrays: what lies before the
stage is computed once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from identify.dynamics.second_order import read_at
from identify.dynamics.variable_speed import LAWS, mean_weights, read_means, run_core
from identify.effects.base import Form, Parameter
from identify.recruitment.spline import SplineBasis
from identify.simulation.setup import Setup

_BASE = (
    Parameter("time_constant_s", "s", 0.012, 3.0, 0.3, (0.2,), "log"),
    Parameter("damping", "1", 0.15, 6.0, 1.0, (0.9,), "log"),
    Parameter("delay_s", "s", -0.03, 0.03, 0.0, (0.0,)),
    Parameter("baseline_nm", "N·m", -4.0, 4.0, 0.0, (0.0,)),
)
FIRST_COEFFICIENT = len(_BASE)
_NONE = np.zeros((0, 1))
SHARED = True


@dataclass(frozen=True)
class Chosen:
    """An effect in one of its forms, as it stands in a problem."""

    effect: str
    form: Form
    parameters: tuple[Parameter, ...]
    first: int

    @property
    def places(self) -> range:
        """Indices of its parameters."""
        return range(self.first, self.first + len(self.parameters))


def extended(basis: SplineBasis, width_us: np.ndarray) -> np.ndarray:
    """Basis functions at widths that a drift may have moved beyond the largest: there straight on; (K, n)."""
    top = basis.knots_us[-1]
    design = basis.design(width_us)
    over = np.clip(width_us - top, 0.0, 0.35 * top)
    if np.any(over > 0.0):
        end = np.array([top])
        design = design + over[:, None] * basis.design(end, 1)
    return design


class Problem:
    """Parameters and stages of one candidate.

    Parameters are kept on the scale on which they're varied (logarithms for those of scale "log").

    Parameters
    ----------
    setup : Setup
        What all candidates share.
    effects : list of (str, Form)
        Effects by id, each in one form, in the order in which they were added.
    """

    def __init__(self, setup: Setup, effects: list[tuple[str, Form]]) -> None:
        self.setup = setup
        coefficients = setup.basis.size
        table = list(_BASE)
        low, high = setup.delay_bounds_s
        table[2] = Parameter("delay_s", "s", low, high, 0.0, (0.0,))
        span = 6.0 * setup.scale_nm
        table += [Parameter(f"recruitment_{i}_nm", "N·m", -span, span) for i in range(coefficients)]
        self.chosen: list[Chosen] = []
        for effect, form in effects:
            own = tuple(p.on(setup.scene) for p in form.parameters)
            self.chosen.append(Chosen(effect, form, own, len(table)))
            table += own
        self.table = table
        self.size = len(table)
        self.coefficients = slice(FIRST_COEFFICIENT, FIRST_COEFFICIENT + coefficients)
        self.log = np.array([p.scale == "log" for p in table])
        self.lower = self._to_scale(np.array([p.lower for p in table]))
        self.upper = self._to_scale(np.array([p.upper for p in table]))
        self._weights: dict[float, tuple[int, np.ndarray]] = {}

    def _to_scale(self, values: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.log(values), values)

    def physical(self, theta: np.ndarray) -> np.ndarray:
        """Parameters in their units."""
        with np.errstate(over="ignore"):
            return np.where(self.log, np.exp(np.where(self.log, theta, 0.0)), theta)

    def from_physical(self, values: np.ndarray) -> np.ndarray:
        """The inverse of `physical`."""
        return self._to_scale(values)

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the parameters' prior and its precision matrix."""
        mean = 0.5 * (self.lower + self.upper)
        sd = np.maximum((self.upper - self.lower) / 3.0, 1e-9)
        mean[:4] = [np.log(0.2), 0.0, 0.5 * (self.lower[2] + self.upper[2]), 0.0]
        sd[:4] = [1.2, 0.8, max((self.upper[2] - self.lower[2]) / 2.0, 1e-5), 1.0]
        precision = np.diag(1.0 / sd**2)
        mean[self.coefficients] = 0.0
        precision[self.coefficients, self.coefficients] = self.setup.penalty
        return mean, precision

    @cached_property
    def step(self) -> np.ndarray:
        """Perturbations for derivatives."""
        size = np.full(self.size, 1e-5)
        size[self.coefficients] = 1e-4 * self.setup.scale_nm
        for chosen in self.chosen:
            for place, p in zip(chosen.places, chosen.parameters, strict=True):
                size[place] = 1e-5 * (1.0 if p.scale == "log" else p.upper - p.lower)
        return size

    # ---- simulation ----

    def run(self, theta: np.ndarray, *, derivatives: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
        """Predicted interval means, N·m, shape (K,), and derivatives, shape (P, K), per unit of `theta`."""
        walk = _Walk(self, theta, derivatives)
        torque, rate, delay = walk.to_boundaries()
        mean = walk.read(torque, rate, delay)
        mean = walk.add(mean)
        mean = walk.sense(mean)
        if not derivatives:
            return mean[0], None
        jacobian = np.zeros((self.size, mean.shape[1]))
        for row, (place, step) in enumerate(walk.owners, start=1):
            jacobian[place] = (mean[row] - mean[0]) / step
        return mean[0], jacobian

    def at_samples(self, theta: np.ndarray, skip: frozenset[str] = frozenset()) -> np.ndarray:
        """Prediction at the record's samples, N·m, shape (N,); effects named in `skip` are left out of the sum."""
        walk = _Walk(self, theta, False)
        torque, rate, delay = walk.to_boundaries()
        grid = self.setup.grid
        position = grid.interval + grid.fraction - delay[0] / grid.step_s
        value = read_at(torque[0], rate[0], position, grid.step_s)[None, :]
        value = walk.add(value, self.setup.scene_at_samples, skip)
        return walk.sense(value, self.setup.scene_at_samples)[0]

    def weights(self, delay_s: float) -> tuple[int, np.ndarray]:
        """Weights of boundary states in interval means, kept for the last few delays."""
        if delay_s not in self._weights:
            if len(self._weights) > 8:
                self._weights.clear()
            grid = self.setup.grid
            self._weights[delay_s] = mean_weights(grid.fraction, grid.interval, grid.count, delay_s / grid.step_s)
        return self._weights[delay_s]


class _Walk:
    """One pass through the stages, with the perturbed rows that have joined so far."""

    def __init__(self, problem: Problem, theta: np.ndarray, derivatives: bool) -> None:
        self.problem, self.setup, self.theta, self.derivatives = problem, problem.setup, theta, derivatives
        self.value = problem.physical(theta)
        self.owners: list[tuple[int, float]] = []

    def join(self, places: range) -> tuple[np.ndarray, np.ndarray]:
        """Let the perturbed rows of some parameters join: rows to take of the input, values (rows, parameters)."""
        present = len(self.owners) + 1
        own = self.value[places.start : places.stop]
        if not self.derivatives:
            return np.arange(present), np.tile(own, (present, 1))
        values = np.tile(own, (present + len(places), 1))
        for i, place in enumerate(places):
            step = self.problem.step[place]
            if self.theta[place] + step > self.problem.upper[place]:
                step = -step
            moved = self.theta[place] + step
            values[present + i, i] = np.exp(moved) if self.problem.log[place] else moved
            self.owners.append((place, step))
        return np.r_[np.arange(present), np.zeros(len(places), np.int64)], values

    def forms(self, stage: str) -> list[Chosen]:
        return [chosen for chosen in self.problem.chosen if chosen.form.stage == stage]

    @staticmethod
    def named(chosen: Chosen, values: np.ndarray) -> dict[str, np.ndarray]:
        return {p.name: values[:, i : i + 1] for i, p in enumerate(chosen.parameters)}

    def to_boundaries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        setup, scene = self.setup, self.setup.scene
        drive = self.recruit()
        for chosen in self.forms("gain"):
            rows, values = self.join(chosen.places)
            drive = np.asarray(chosen.form.call(drive[rows], self.named(chosen, values), scene))
        torque, rate = self.dynamics(drive)
        delay = np.full(torque.shape[0], self.value[2])
        rows, values = self.join(range(2, 3))
        torque, rate, delay = torque[rows], rate[rows], values[:, 0]
        for chosen in self.forms("delay"):
            rows, values = self.join(chosen.places)
            torque, rate = torque[rows], rate[rows]
            lag = np.asarray(chosen.form.call(None, self.named(chosen, values), scene))
            delay = delay[rows] + lag.reshape(lag.shape[0], -1)[:, 0]
        ends = setup.scene_at_ends
        for chosen in self.forms("filter"):
            rows, values = self.join(chosen.places)
            torque, rate = chosen.form.call((torque[rows], rate[rows]), self.named(chosen, values), ends)
        for chosen in self.forms("output"):
            rows, values = self.join(chosen.places)
            torque, rate = self.bend(chosen, torque[rows], rate[rows], values)
        return torque, rate, delay

    def recruit(self) -> np.ndarray:
        setup, problem = self.setup, self.problem
        width = setup.grid.pulse_width_us[None, :]
        coefficients = self.value[problem.coefficients]
        acting = self.forms("pulse_width")
        for chosen in acting:
            rows, values = self.join(chosen.places)
            width = np.asarray(chosen.form.call(width[rows], self.named(chosen, values), setup.scene))
        if not acting:
            design = setup.design
            drive = (coefficients @ design)[None, :]
        else:
            design = np.ascontiguousarray(extended(setup.basis, width[0]).T)
            others = [extended(setup.basis, row) @ coefficients for row in width[1:]]
            drive = np.stack([coefficients @ design, *others])
        if self.derivatives:
            step = problem.step[problem.coefficients]
            places = range(problem.coefficients.start, problem.coefficients.stop)
            self.owners += [(place, float(s)) for place, s in zip(places, step, strict=True)]
            drive = np.concatenate([drive, drive[:1] + step[:, None] * design])
        return drive

    def dynamics(self, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        setup = self.setup
        rows, core = self.join(range(2))
        drive = drive[rows]
        law = np.zeros((drive.shape[0], LAWS))
        given: list[tuple[Chosen, np.ndarray]] = []
        for chosen in self.forms("speed"):
            rows, values = self.join(chosen.places)
            drive, core, law = drive[rows], core[rows], law[rows]
            given = [(other, old[rows]) for other, old in given]
            if chosen.form.law:
                names = [p.name for p in chosen.parameters]
                for name, column in chosen.form.law.items():
                    value = values[:, names.index(name)]
                    law[:, column] += np.log(value) if name in chosen.form.log_law else value
            else:
                given.append((chosen, values))
        branches = [(drive, np.ones((drive.shape[0], 1)))]
        for chosen in self.forms("branch"):
            rows, values = self.join(chosen.places)
            core, law, drive = core[rows], law[rows], drive[rows]
            given = [(other, old[rows]) for other, old in given]
            split = []
            for part, slower in branches:
                for new, factor in chosen.form.call(part[rows], self.named(chosen, values), setup.scene):
                    split.append((new, slower[rows] * factor))
            branches = split
        torque, rate = self.respond(branches, core, law, _NONE)
        # A law given as a function of whole arrays is met by a few passes, each with the torque of the last.
        for _ in range(4 if given else 0):
            factor = np.ones_like(drive)
            for chosen, values in given:
                middle = 0.5 * (torque[:, 1:] + torque[:, :-1])
                factor = factor * np.asarray(chosen.form.call((drive, middle), self.named(chosen, values), setup.scene))
            if np.all(factor == 1.0):
                break
            torque, rate = self.respond(branches, core, law, np.ascontiguousarray(np.clip(factor, 0.02, 50.0)))
        return torque, rate

    def respond(
        self, branches: list, core: np.ndarray, law: np.ndarray, multiplier: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        setup = self.setup
        torque = rate = None
        for part, slower in branches:
            one, two = run_core(
                np.ascontiguousarray(part),
                np.ascontiguousarray(core[:, 0] * slower[:, 0]),
                np.ascontiguousarray(core[:, 1]),
                law,
                multiplier,
                setup.scale_nm,
                setup.grid.step_s,
                SHARED,
            )
            torque = one if torque is None else torque + one
            rate = two if rate is None else rate + two
        assert torque is not None and rate is not None
        return torque, rate

    def bend(
        self, chosen: Chosen, torque: np.ndarray, rate: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A static output at the boundary states; the rate follows by the chain rule, taken numerically."""
        p, ends = self.named(chosen, values), self.setup.scene_at_ends
        bent = np.asarray(chosen.form.call(torque, p, ends))
        if np.array_equal(bent, torque):
            return bent, rate
        ahead = self.setup.grid.step_s / 32.0
        later = np.asarray(chosen.form.call(torque + ahead * rate, p, ends))
        sooner = np.asarray(chosen.form.call(torque - ahead * rate, p, ends))
        return bent, (later - sooner) / (2 * ahead)

    def read(self, torque: np.ndarray, rate: np.ndarray, delay: np.ndarray) -> np.ndarray:
        first, weights = self.problem.weights(float(delay[0]))
        step_s = self.setup.grid.step_s
        mean = read_means(torque, rate, first, weights, step_s)
        for row in np.flatnonzero(delay != delay[0]):
            first, weights = self.problem.weights(float(delay[row]))
            mean[row] = read_means(torque[row : row + 1], rate[row : row + 1], first, weights, step_s)[0]
        return mean

    def add(self, value: np.ndarray, scene=None, skip: frozenset[str] = frozenset()) -> np.ndarray:
        at_samples = scene is not None
        scene = scene or self.setup.scene
        rows, values = self.join(range(3, 4))
        value = value[rows] + values
        for chosen in self.forms("additive"):
            present = value.shape[0]
            rows, values = self.join(chosen.places)
            value = value[rows]
            if chosen.effect in skip or (not at_samples and chosen.effect == "mains_hum"):
                continue
            # What is added doesn't depend on the signal: rows that differ elsewhere alone share one evaluation.
            own = np.r_[0, np.arange(present, rows.size)]
            added = np.asarray(chosen.form.call(None, self.named(chosen, values[own]), scene))
            value[:present] += added[:1]
            value[present:] += added[1:]
        return value

    def sense(self, value: np.ndarray, scene=None) -> np.ndarray:
        for chosen in self.forms("sensor"):
            rows, values = self.join(chosen.places)
            value = np.asarray(chosen.form.call(value[rows], self.named(chosen, values), scene or self.setup.scene))
        return value
