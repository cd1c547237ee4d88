"""A candidate model (f, G and effects) as a function of its parameters: its simulation and the derivatives.

The signal passes the stages in a fixed order. For a derivative, a parameter is perturbed at its own stage, and the
perturbed signal passes all later stages as one more row of the same arrays. What comes before the stage is computed
only once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.linear import DAMPING_BOUNDS, TIME_CONSTANT_BOUNDS_S
from stimrig.identify.dynamics.second_order import Core, read_means
from stimrig.identify.dynamics.terms import lags_of, run_terms
from stimrig.identify.dynamics.variable_speed import Lag, SpeedLaw, run_core
from stimrig.identify.effects.base import Form, Parameter, Values
from stimrig.identify.problem.setup import Setup, extended

TERM_SD = 1.0
"""Prior standard deviation of a term's size."""


@dataclass(frozen=True)
class Chosen:
    """An effect in one of its forms, with the place of its parameters in a problem."""

    effect: str
    form: Form
    parameters: tuple[Parameter, ...]
    first: int

    @property
    def places(self) -> range:
        """Indices of its parameters."""
        return range(self.first, self.first + len(self.parameters))


class Problem:
    """The parameters and stages of one candidate model.

    `theta` holds parameters on the scale on which they are varied: logarithms for those of scale "log".

    `setup`: what all candidates of a record share; `effects`: effects by id, each in one form, in the order in which
    they were added.
    """

    def __init__(self, setup: Setup, effects: list[tuple[str, Form]]) -> None:
        self.setup, self.effects = setup, effects
        parts, span = setup.grid.begins.size, 6.0 * setup.scale_nm
        table = [
            Parameter("time_constant_s", "s", *TIME_CONSTANT_BOUNDS_S, 0.3, (0.2,), "log"),
            Parameter("damping", "1", *DAMPING_BOUNDS, 1.0, (0.9,), "log"),
            Parameter("delay_s", "s", *setup.delay_bounds_s),
        ]
        numbers = ["", *(f"_{part}" for part in range(2, parts + 1))]
        rests = setup.rests_nm[0].tolist() if setup.rests_nm else [0.0] * parts
        table += [Parameter(f"baseline{n}_nm", "N·m", r - span, r + span) for n, r in zip(numbers, rests, strict=True)]
        states = setup.grid.starts.size
        for number in ["", *(f"_{state}" for state in range(2, states + 1))]:
            table.append(Parameter(f"initial_torque{number}_nm", "N·m", -span, span))
            table.append(Parameter(f"initial_rate{number}_nm_s", "N·m/s", -10 * span, 10 * span))
        self.delay = range(2, 3)
        self.baselines = range(3, 3 + parts)
        self.initials = range(3 + parts, 3 + parts + 2 * states)
        self.coefficients = slice(len(table), len(table) + setup.basis.size)
        table += [Parameter(f"recruitment_{i}_nm", "N·m", -np.inf, np.inf) for i in range(setup.basis.size)]
        self.linear = np.arange(self.baselines.start, self.coefficients.stop)
        """Zeros, initial states and the curve: without effects the mean is linear in them."""
        self.chosen: list[Chosen] = []
        for effect, form in effects:
            parameters = tuple(p.on(setup.scene) for p in form.parameters)
            self.chosen.append(Chosen(effect, form, parameters, len(table)))
            table += parameters
        self.table = table
        self.size = len(table)
        self.log = np.array([p.scale == "log" for p in table])
        self.lower = self.from_physical(np.array([p.lower for p in table]))
        self.upper = self.from_physical(np.array([p.upper for p in table]))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters; those of an effect start with its id: `fatigue.onset_s`."""
        effect_parameters = [f"{chosen.effect}.{p.name}" for chosen in self.chosen for p in chosen.parameters]
        return (*(p.name for p in self.table[: self.coefficients.stop]), *effect_parameters)

    def physical(self, theta: np.ndarray) -> np.ndarray:
        """Parameters in their units."""
        with np.errstate(over="ignore"):
            return np.where(self.log, np.exp(np.where(self.log, theta, 0.0)), theta)

    def from_physical(self, values: np.ndarray) -> np.ndarray:
        """The inverse of `physical`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.log(values), values)

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and precision matrix of the prior of `theta`."""
        inside = np.isfinite(self.lower) & np.isfinite(self.upper)
        mean = np.zeros(self.size)
        mean[inside] = 0.5 * (self.lower[inside] + self.upper[inside])
        sd = np.ones(self.size)
        sd[inside] = np.maximum((self.upper[inside] - self.lower[inside]) / 3.0, 1e-9)
        mean[:2], sd[:2] = [np.log(0.2), 0.0], [1.2, 0.8]
        sd[[chosen.first for chosen in self.chosen if chosen.form.stage == "term"]] = TERM_SD
        sd[2] = max((self.upper[2] - self.lower[2]) / 2.0, 1e-5)
        scale = self.setup.scale_nm
        at = slice(self.baselines.start, self.baselines.stop)
        mean[at], sd[at] = self.setup.rests_nm or (0.0, 0.5 * scale)
        sd[list(self.initials)] = np.tile([scale, 5.0 * scale], self.setup.grid.starts.size)
        mean[self.coefficients] = self.setup.curve_nm
        precision = np.diag(1.0 / sd**2)
        precision[self.coefficients, self.coefficients] = self.setup.penalty
        return mean, precision

    @cached_property
    def prior_log_det(self) -> float:
        """Logarithm of the determinant of the prior's precision."""
        return float(np.linalg.slogdet(self.prior[1])[1])

    @cached_property
    def step(self) -> np.ndarray:
        """Perturbation of each parameter for its derivative, on the scale of `theta`."""
        size = np.full(self.size, 1e-5)
        size[self.baselines.start : self.coefficients.stop] = 1e-4 * self.setup.scale_nm
        for chosen in self.chosen:
            for place, p in zip(chosen.places, chosen.parameters, strict=True):
                size[place] = 1e-5 * (1.0 if p.scale == "log" else p.upper - p.lower)
        return size

    # ---- simulation ----

    def run(
        self, theta: np.ndarray, *, derivatives: bool = False, skip: frozenset[str] = frozenset()
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Predicted interval means, N·m, shape (K,), and derivatives, shape (P, K), per unit of `theta`.

        Additive effects in `skip` are left out.
        """
        stages = _StagePass(self, theta, derivatives)
        mean = stages.read(*stages.to_boundaries())
        mean = stages.add(mean, skip=skip)
        mean = stages.sense(mean)
        if not derivatives:
            return mean[0], None
        places, steps = zip(*stages.owners, strict=True)
        change = mean[1:]
        change -= mean[0]
        change /= np.array(steps)[:, None]
        jacobian = np.zeros((self.size, mean.shape[1]))
        jacobian[list(places)] = change
        return mean[0], jacobian

    def states(self, theta: np.ndarray) -> dict[str, float]:
        """By effect id, the slow state that each effect with one (`Form.state`) has at the record's end, 0 to 1."""
        slow_states: dict[str, float] = {}
        _StagePass(self, theta, False).gained(slow_states)
        return slow_states

    def inner_signals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Width, µs, and drive, N·m, before all terms, shape (K,), and torque behind the lags, N·m, shape (K + 1,)."""
        stages = _StagePass(self, theta, False)
        drive = stages.gained()
        return stages.width[0], drive[0], stages.dynamics(drive)[0][0]

    def at_samples(self, theta: np.ndarray, skip: frozenset[str] = frozenset()) -> np.ndarray:
        """Torque at the record's samples, with its sign and zero, N·m; what effects in `skip` add is left out."""
        stages = _StagePass(self, theta, False)
        torque, rate, delay, _ = stages.to_boundaries()
        grid = self.setup.grid
        value = grid.at_samples(torque[0], rate[0], delay[0] / grid.step_s, stages.curves()[0])[None, :]
        value = stages.add(value, self.setup.scene_at_samples, skip)
        return self.setup.to_record(stages.sense(value, self.setup.scene_at_samples, skip)[0])


class _StagePass:
    """One pass of the signal through the stages. Row 0 is the model; each further row has one perturbed parameter.

    The rows of a stage's parameters come behind those of the stages before it. In all before, they are like row 0.
    """

    def __init__(self, problem: Problem, theta: np.ndarray, derivatives: bool) -> None:
        self.problem, self.setup, self.theta, self.derivatives = problem, problem.setup, theta, derivatives
        self.value = problem.physical(theta)
        self.owners: list[tuple[int, float]] = []

    def join(self, places: range) -> np.ndarray:
        """Add a perturbed row for each of some parameters; their values in all rows, in their units, (M, places)."""
        present = len(self.owners) + 1
        nominal = self.value[places.start : places.stop]
        values = np.full((present + len(places) * self.derivatives, len(places)), nominal)
        for i, place in enumerate(places if self.derivatives else ()):
            step = self.problem.step[place]
            if self.theta[place] + step > self.problem.upper[place]:
                step = -step
            moved = self.theta[place] + step
            values[present + i, i] = np.exp(moved) if self.problem.log[place] else moved
            self.owners.append((place, step))
        return values

    def grown(self, rows: np.ndarray) -> np.ndarray:
        """An array of an earlier stage, with the rows that have come since then."""
        if len(rows) == len(self.owners) + 1:
            return rows
        grown = np.empty((len(self.owners) + 1, *rows.shape[1:]), rows.dtype)
        grown[: len(rows)], grown[len(rows) :] = rows, rows[0]
        return grown

    def forms(self, stage: str) -> list[Chosen]:
        return [chosen for chosen in self.problem.chosen if chosen.form.stage == stage]

    def joined(self, stage: str) -> Iterator[tuple[Chosen, Values]]:
        """The forms of a stage, one after the other, with the parameters of all rows."""
        for chosen in self.forms(stage):
            yield chosen, self.named(chosen, self.join(chosen.places))

    @staticmethod
    def named(chosen: Chosen, values: np.ndarray) -> Values:
        columns = np.ascontiguousarray(values.T)  # compiled functions are then compiled for one layout alone
        return {p.name: columns[i, :, None] for i, p in enumerate(chosen.parameters)}

    def to_boundaries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """States at the ends of the intervals (torque, rate), and for each row its delay, s, and which states it
        uses."""
        torque, rate = self.dynamics(self.gained())
        # A delay changes where the states are read, not the states: rows that differ only in delay share them.
        owned, delay = np.arange(len(torque)), self.join(self.problem.delay)[:, 0]
        for chosen, p in self.joined("delay"):
            lag = np.asarray(chosen.form.call(None, p, self.setup.scene))
            delay = self.grown(delay) + lag.reshape(lag.shape[0], -1)[:, 0]
        owned = self.grown(owned)
        if not (self.forms("filter") or self.forms("output")):
            return torque, rate, delay, owned
        torque, rate = torque[owned], rate[owned]
        for chosen, p in self.joined("filter"):
            torque, rate = chosen.form.call((self.grown(torque), self.grown(rate)), p, self.setup.scene_at_ends)
        for chosen in self.forms("output"):
            torque, rate = self.shaped(chosen, torque, rate)
        return torque, rate, self.grown(delay), np.arange(len(torque))

    def gained(self, states: dict[str, float] | None = None) -> np.ndarray:
        """The drive behind the gain stage; with `states`, the slow states of row 0 at the end are written there."""
        drive = self.recruit()
        for chosen, p in self.joined("gain"):
            drive = self.grown(drive)
            if states is not None and chosen.form.state is not None:
                states[chosen.effect] = float(chosen.form.state(drive, p, self.setup.scene)[0])
            drive = np.asarray(chosen.form.call(drive, p, self.setup.scene))
        return drive

    def recruit(self) -> np.ndarray:
        setup, problem = self.setup, self.problem
        width = setup.grid.pulse_width_us[None, :].copy()
        coefficients = self.value[problem.coefficients]
        for chosen, p in self.joined("pulse_width"):
            width = np.asarray(chosen.form.call(self.grown(width), p, setup.scene))
        self.width = np.array(width, float)
        if not self.forms("pulse_width"):
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
        return setup.grid.interval_means(drive, axis=1)

    def dynamics(self, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        core, initial = self.join(range(2)), self.join(self.problem.initials)
        speeds, terms = ([(each, self.join(each.places)) for each in self.forms(stage)] for stage in ("speed", "term"))
        if terms and (self.derivatives or any(values[0, 0] for _, values in terms)):
            self.cores = self.grown(core)
            return self.by_terms(drive, terms, initial[0])
        branches = [(drive, np.ones((len(drive), 1)))]
        for chosen, p in self.joined("branch"):
            branches = [
                (new, self.grown(slower) * factor)
                for part, slower in branches
                for new, factor in chosen.form.call(self.grown(part), p, self.setup.scene)
            ]
        branches = [(self.grown(part), self.grown(slower)) for part, slower in branches]
        self.cores, initial = self.grown(core), self.grown(initial)
        law = np.zeros((len(initial), len(Lag), len(SpeedLaw)))
        for chosen, values in speeds:
            p = self.named(chosen, self.grown(values))
            logs = {parameter.name for parameter in chosen.parameters if parameter.scale == "log"}
            for column, name in chosen.form.law.items():
                value = p[name][:, 0] if isinstance(name, str) else name
                law[:, *np.atleast_1d(column)] += np.log(value) if name in logs else value
        return self.respond(branches, law, initial)

    def respond(self, branches: list, law: np.ndarray, initial: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sum of the responses of all branches, each from its share of the initial state."""
        setup, responses = self.setup, []
        begin = initial.reshape(initial.shape[0], -1, 2) / len(branches)
        shared = law, setup.grid.starts, begin, setup.scale_nm, setup.grid.step_s
        for part, slower in branches:
            drive, core = np.ascontiguousarray(part), self.cores * np.c_[slower, np.ones_like(slower)]
            time_constant_s, damping = np.ascontiguousarray(core.T)
            responses.append(run_core(drive, time_constant_s, damping, *shared))
        if len(responses) == 1:
            return responses[0]
        return sum(torque for torque, _ in responses), sum(rate for _, rate in responses)  # type: ignore

    def by_terms(
        self, drive: np.ndarray, terms: list[tuple[Chosen, np.ndarray]], initial: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Response where terms act on the lags: each further row is row 0 and a step along its exact derivative."""
        setup, problem = self.setup, self.problem
        at = {place: number for number, (place, _) in enumerate(self.owners)}
        steps = np.array([step for _, step in self.owners])
        drives = np.zeros((steps.size, drive.shape[1]))
        drives[: len(drive) - 1] = (drive[1:] - drive[0]) / steps[: len(drive) - 1, None]
        lags, by_lag = lags_of(*self.value[:2])
        lag_slopes = np.zeros((steps.size, 3))
        initials = np.zeros((steps.size, initial.size))
        for place in range(2):
            if place in at:
                lag_slopes[at[place]] = by_lag[place]
        for number, place in enumerate(problem.initials):
            if place in at:
                initials[at[place], number] = 1.0
        known = [i for i in range(problem.coefficients.start, problem.coefficients.stop) if i in at]
        design = setup.table
        forms = [chosen.form for chosen, _ in terms]
        numbers = np.array([[values[0, 0], (*values[0], chosen.form.law["lag"])[1]] for chosen, values in terms])
        own = [[at.get(p, -1) for p in (*chosen.places, -1)[:2]] for chosen, _ in terms]
        torque, rate, torques, rates = run_terms(
            np.ascontiguousarray(drive[0]),
            drives,
            self.width[0] / setup.basis.largest_us,
            (self.width[1:] - self.width[0]) / (steps[: len(self.width) - 1, None] * setup.basis.largest_us),
            setup.present,
            setup.scene.rest_s,
            self.value[problem.coefficients] @ design,
            design,
            np.array([at[i] for i in known], np.int64),
            lags,
            lag_slopes,
            np.array([form.law["place"] for form in forms]),
            np.array([form.law["driver"] for form in forms]),
            np.ascontiguousarray(numbers[:, 0]),
            np.ascontiguousarray(numbers[:, 1]),
            np.array(own),
            setup.grid.starts,
            initial.reshape(-1, 2),
            initials.reshape(steps.size, initial.size // 2, 2),
            setup.scale_nm,
            setup.grid.step_s,
        )
        steps = steps[:, None]
        return np.vstack([torque, torque + steps * torques]), np.vstack([rate, rate + steps * rates])

    def shaped(self, chosen: Chosen, torque: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A static output stage at the boundary states."""
        present, values = len(self.owners) + 1, self.join(chosen.places)
        torque, rate = self.grown(torque), self.grown(rate)
        form, ends = chosen.form, self.setup.scene_at_ends
        if form.scales:  # rows with the same parameters, the first `present` ones, share a factor
            p = self.named(chosen, values[np.r_[0, present : len(values)]])
            factor = np.asarray(form.call(np.ones((1, ends.time_s.size)), p, ends))
            torque, rate = torque.copy(), rate.copy()
            for rows in (torque, rate):
                rows[:present] *= factor[:1]
                rows[present:] *= factor[1:]
            return torque, rate
        p = self.named(chosen, values)
        bent = np.asarray(form.call(torque, p, ends))
        if np.array_equal(bent, torque):
            return bent, rate
        lead_s = self.setup.grid.step_s / 32.0  # the rate follows by a numerical chain rule
        later = np.asarray(form.call(torque + lead_s * rate, p, ends))
        sooner = np.asarray(form.call(torque - lead_s * rate, p, ends))
        return bent, (later - sooner) / (2 * lead_s)

    def read(self, torque: np.ndarray, rate: np.ndarray, delay: np.ndarray, owned: np.ndarray) -> np.ndarray:
        grid = self.setup.grid
        mean = np.empty((delay.size, grid.size))
        rows_by_reading: dict[tuple[float, Core | None], list[int]] = {}
        for row, read in enumerate(zip(delay.tolist(), self.curves(), strict=True)):
            rows_by_reading.setdefault(read, []).append(row)
        for (lag, core), rows in rows_by_reading.items():
            read_means(torque, rate, *grid.mean_weights(lag, core), owned[rows], mean, np.array(rows))
        return mean

    def curves(self) -> list[Core | None]:
        """Reading of each row's curve: exactly, from its T and ζ; or all as cubics, if both lags are long."""
        cores: list[Core] = [(time_constant_s, damping) for time_constant_s, damping in self.grown(self.cores).tolist()]
        return [*cores] if self.setup.grid.curve(cores[0]) else [None] * len(cores)

    def add(self, value: np.ndarray, scene=None, skip: frozenset[str] = frozenset()) -> np.ndarray:
        part = self.setup.part_of(scene is not None)
        values = self.join(self.problem.baselines)
        value = self.grown(value) + (values if part is None else values[:, part])
        for chosen in self.forms("additive"):
            present, values = len(value), self.join(chosen.places)
            value = self.grown(value)
            if chosen.effect in skip:
                continue
            # An added torque does not depend on the signal: rows with the same parameters share one evaluation.
            distinct = np.r_[0, np.arange(present, len(value))]
            added = np.asarray(chosen.form.call(None, self.named(chosen, values[distinct]), scene or self.setup.scene))
            value[:present] += added[:1]
            value[present:] += added[1:]
        return value

    def sense(self, value: np.ndarray, scene=None, skip: frozenset[str] = frozenset()) -> np.ndarray:
        """Apply the sensor stage, which works with the record's own zero and sign."""
        for chosen, p in self.joined("sensor"):
            value = self.grown(value)
            if chosen.effect in skip or (scene is None and chosen.form.fixed):  # the target was corrected for it
                continue
            record_nm = self.setup.to_record(value)
            sensor_nm = np.asarray(chosen.form.call(record_nm, p, scene or self.setup.scene))
            value = np.where(sensor_nm == record_nm, value, self.setup.to_muscle(sensor_nm))
        return value
