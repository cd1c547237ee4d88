"""One estimate of all muscles together: each by itself with the others' torque taken away, in turn; then all at once.

The turns (backfitting) give each muscle the knots and the smoothness of its curve, as a record of that muscle alone
would; the last step is Newton's on all parameters, with one noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects.base import Form
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.joint import Fitted, solve
from stimrig.identify.estimation.plain import estimate, pilot_solution, to_fitted
from stimrig.identify.estimation.samples import Raw, fitted_rows, prepare
from stimrig.identify.muscles.problem import Acting, JointProblem, drive_form
from stimrig.identify.muscles.record import JointRecord
from stimrig.identify.noise import WHITE, NoiseLevel
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.simulation.setup import Setup
from stimrig.identify.summary import quantity

PILOT_TURNS, TURNS = 12, 2
SETTLED = 0.01
"""Change of the muscles' torques in a turn, as a share of their size, from which no further turn follows."""
SLOW = 0.3
"""Share of the noise, times the correlation of neighbours, from which a fit is begun again with white noise."""
PINNED = 1e-6
"""Share of the torque within which the zero of a further muscle is held at 0: the joint has one zero."""
Start = Mapping[str, Mapping[str, float]]
"""Values of parameters by the name of what acts, and by their own name."""


@dataclass(frozen=True, eq=False)
class JointFitted:
    """All muscles fitted to a record."""

    record: JointRecord  # as `prepared` gives it
    measured: JointRecord  # as it was given
    grids: tuple[Grid, ...]  # with the whole torque
    raw: Raw
    effects: tuple[tuple[tuple[str, Form], ...], ...]  # of each muscle
    acting: tuple[Acting, ...]
    fitted: Fitted

    @property
    def problem(self) -> JointProblem:
        """Of all muscles."""
        assert isinstance(self.fitted.problem, JointProblem)
        return self.fitted.problem

    @property
    def setups(self) -> list[Setup]:
        """Of each muscle."""
        return [part.setup for part in self.problem.parts]

    @cached_property
    def white(self) -> JointFitted:
        """The same with its noise held white: slow noise may hold what the structure leaves, and bend the curves."""
        return replace(self, fitted=solve(self.problem, self.fitted.theta, WHITE))

    @cached_property
    def predicted(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Whole torque at the samples, N·m, and that of each muscle without the zero."""
        return self.problem.whole_and_parts(self.fitted.theta)

    @cached_property
    def views(self) -> tuple[Fitted, ...]:
        """Each muscle as if it had been measured alone: the others' torque taken away, their doubt counted in."""
        return tuple(self._view(place) for place in range(len(self.grids)))

    def _view(self, place: int) -> Fitted:
        part, whole = self.problem.parts[place], self.fitted
        own = list(range(part.size))
        for chosen in part.chosen:
            if chosen.effect not in dict(self.effects[place]):
                own = [i for i in own if i not in chosen.places]
        at = self.problem.places[place].start + np.array(own)
        others = np.setdiff1d(np.arange(self.problem.size), at)
        theta = whole.theta[at]
        alone = Problem(part.setup, list(self.effects[place]))
        turned = self.problem.turned[place]
        residual_nm = turned * whole.residual_nm
        own_nm, left_nm = alone.at_samples(theta), self.record.torque_nm - self.predicted[0]
        record = self.record.records[place].with_torque(own_nm + left_nm)
        means_nm = part.setup.to_record(alone.run(theta)[0] + residual_nm)
        grid = replace(self.grids[place], record=record, torque_nm=means_nm)
        setup = part.setup.with_(grid=grid, target_nm=part.setup.to_muscle(means_nm))
        crossed = whole.hessian[np.ix_(at, others)]
        doubt = whole.hessian[np.ix_(others, others)]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(doubt), 1e-300))
        inner = scale[:, None] * np.linalg.solve(
            doubt * scale[:, None] * scale + 1e-12 * np.eye(scale.size), scale[:, None] * crossed.T
        )
        hessian = whole.hessian[np.ix_(at, at)] - crossed @ inner
        return replace(
            whole,
            problem=Problem(setup, list(self.effects[place])),
            theta=theta,
            residual_nm=residual_nm,
            slopes=turned * whole.slopes[at],
            hessian=0.5 * (hessian + hessian.T),
        )

    def with_(
        self,
        effects: Sequence[Sequence[tuple[str, Form]]] | None = None,
        acting: Sequence[Acting] | None = None,
        start: Start | None = None,
    ) -> JointFitted:
        """With other effects, or another interplay, from this solution; `start`: values of what is new."""
        effects = tuple(tuple(one) for one in (self.effects if effects is None else effects))
        acting = self.acting if acting is None else tuple(acting)
        problem = assemble(self.setups, effects, acting)
        fitted = solve(problem, _carried(problem, self, start or {}), self.fitted.noise)
        if _slow(fitted.noise):
            begun = solve(problem, _carried(problem, self.white, start or {}), WHITE)
            again = solve(problem, begun.theta, NoiseLevel(0.0, 0.5, begun.noise.sd_nm))
            fitted = max(fitted, again, key=lambda one: one.log_evidence)
        return replace(self, effects=effects, acting=acting, fitted=fitted)

    def with_likeliest(self, forms: Sequence[Acting]) -> JointFitted:
        """With the form of an interplay that the evidence prefers."""
        tried = [self.with_(acting=[*self.acting, form]) for form in forms]
        return max(tried, key=lambda one: one.fitted.log_evidence)

    def with_effect(self, place: int, effect: str, form: Form, values: Mapping[str, float]) -> JointFitted:
        """With one more effect of a muscle, begun at these values."""
        effects = [list(own) for own in self.effects]
        effects[place].append((effect, form))
        return self.with_(effects=effects, start={f"{place}.{effect}": values})

    def without(self, key: str) -> JointFitted:
        """Without what is called so: an interplay, or "biceps.fatigue"; what is of the joint is the first muscle's."""
        names = self.record.names
        acting = [one for one in self.acting if one.key(names) != key]
        whose, _, effect = key.partition(".")
        place = names.index(whose) if whose in names else 0
        effects = [[one for one in own if i != place or one[0] != effect] for i, own in enumerate(self.effects)]
        return self.with_(effects=effects, acting=acting)


def _slow(noise: NoiseLevel) -> bool:
    return not noise.held and min(noise.share, 1.0) * noise.ar1 > SLOW


def assemble(
    setups: Sequence[Setup], effects: Sequence[Sequence[tuple[str, Form]]], acting: Sequence[Acting]
) -> JointProblem:
    """The problem of all muscles."""
    parts, grids, bases = [], [setup.grid for setup in setups], [setup.basis for setup in setups]
    for place, (setup, own) in enumerate(zip(setups, effects, strict=True)):
        reached = [
            (_cross_name(one), drive_form(one, grids, bases))
            for one in acting
            if one.between and one.between[1] == place
        ]
        parts.append(Problem(setup, [*reached, *own]))
    joint = [(one.interplay, one.interplay.form(one.form)) for one in acting if one.between is None]
    return JointProblem(parts, joint)


def _cross_name(acting: Acting) -> str:
    assert acting.between is not None
    return f"{acting.interplay.id}:{acting.between[0]}"


def named_values(
    problem: JointProblem, theta: np.ndarray, acting: Sequence[Acting]
) -> list[dict[str, tuple[float, int]]]:
    """Of each interplay, its parameters by name: value, and place in `theta`."""
    found = []
    values = problem.physical(theta)
    joint = iter(problem.own)
    for one in acting:
        if one.between is None:
            chosen, first = next(joint), 0
        else:
            part, first = problem.parts[one.between[1]], problem.places[one.between[1]].start
            chosen = next(each for each in part.chosen if each.effect == _cross_name(one))
        places = [first + place for place in chosen.places]
        found.append({p.name: (float(values[i]), i) for p, i in zip(chosen.parameters, places, strict=True)})
    return found


def _carried(problem: JointProblem, before: JointFitted, start: Start) -> np.ndarray:
    """A start: the solution before, and starting values of what is new."""
    theta = np.zeros(problem.size)
    own = before.problem.split(before.fitted.theta)
    for place, (part, old, old_theta) in enumerate(zip(problem.parts, before.problem.parts, own, strict=True)):
        values = np.zeros(part.size)
        values[: part.coefficients.stop] = old.physical(old_theta)[: part.coefficients.stop]
        known = {
            chosen.effect: old.physical(old_theta)[list(chosen.places)] for chosen in old.chosen if chosen.form.name
        }
        forms = {chosen.effect: chosen.form.name for chosen in old.chosen}
        for chosen in part.chosen:
            if chosen.effect in known and forms[chosen.effect] == chosen.form.name:
                values[list(chosen.places)] = known[chosen.effect]
                continue
            given = start.get(f"{place}.{chosen.effect}", {})
            values[list(chosen.places)] = [
                np.clip(given.get(p.name, p.start[0]), p.lower, p.upper) for p in chosen.parameters
            ]
        theta[problem.places[place]] = part.from_physical(values)
    old_joint = {one.effect: (one.form.name, before.fitted.theta[list(one.places)]) for one in before.problem.own}
    for one in problem.own:
        if one.effect in old_joint and old_joint[one.effect][0] == one.form.name:
            theta[list(one.places)] = old_joint[one.effect][1]
        else:
            given = start.get(one.effect, {})
            theta[list(one.places)] = [given.get(p.name, p.start[0]) for p in one.parameters]
    return theta


def prepared(record: JointRecord) -> tuple[JointRecord, tuple[Grid, ...], Raw]:
    """The record without hum, its clipped samples doubted, with notes on both; its grids; what its samples show.

    Raises BadRecord, NotIdentifiable: as `prepare`, or a channel has no pulse.
    """
    for channel, one in zip(record.channels, record.records, strict=True):
        if not np.max(one.pulse_width_us[~one.held_out], initial=0.0) > 0:
            fix = "Play a test of all channels, or leave this one out."
            raise NotIdentifiable(f"no pulse of {channel.name} is among the fitted rows", place=channel.name, fix=fix)
    _, raw = prepare(record.records[0])
    record = _cleaned(record, raw)
    known = {"noise_sd_nm": raw.noise_sd_nm, "readings": raw.readings}
    return record, tuple(replace(grid, **known) for grid in record.grids), raw


def _cleaned(record: JointRecord, raw: Raw) -> JointRecord:
    measured_nm, notes = record.torque_nm, []
    clipped = np.zeros(measured_nm.size, bool)
    if raw.hum is not None:
        notes.append(f"Mains hum of {raw.hum['frequency_hz']:.0f} Hz was taken away.")
    if raw.ceiling_nm is not None or raw.floor_nm is not None:
        top_nm = np.inf if raw.ceiling_nm is None else raw.ceiling_nm
        bottom_nm = -np.inf if raw.floor_nm is None else raw.floor_nm
        clipped = (measured_nm >= top_nm) | (measured_nm <= bottom_nm)
        share = quantity(100.0 * float(np.mean(clipped)), "%")
        notes.append(f"The sensor reaches the end of its range: {share} of the samples are left out.")
    if not notes:
        return record
    cleaned = [
        replace(one.with_torque(raw.torque_nm), doubted=clipped | (one.doubted if one.doubted is not None else False))
        for one in record.records
    ]
    first = cleaned[0].source
    cleaned[0] = replace(cleaned[0], source=replace(first, notes=(*first.notes, *notes)))
    return replace(record, records=tuple(cleaned))


def fit_all(record: JointRecord) -> JointFitted:
    """The plain structure of all muscles: each a Hammerstein model, their torques added.

    Raises BadRecord, NotIdentifiable: as `prepared`, or the record does not tell the muscles apart.
    """
    measured, (record, grids, raw) = record, prepared(record)
    rows = fitted_rows(grids[0], None)
    torques = _pilots(grids, rows)
    fits: list[Fitted] = []
    for _ in range(TURNS):
        fits = []
        for place, grid in enumerate(grids):
            own = _without(grid, sum(t for i, t in enumerate(torques) if i != place))
            fitted = to_fitted(estimate(own, rows)[0], rows)
            fits.append(fitted)
            torques[place] = _torque_of(fitted)
    return _together(measured, record, grids, raw, fits)


def _without(grid: Grid, others_nm: np.ndarray | float) -> Grid:
    """The grid with other muscles' torque taken away, its record, too: each sample by its interval's mean."""
    others = np.broadcast_to(others_nm, grid.torque_nm.shape)
    record = grid.record.with_torque(grid.record.torque_nm - others[grid.interval])
    return replace(grid, torque_nm=grid.torque_nm - others, record=record)


def _pilots(grids: Sequence[Grid], rows: np.ndarray) -> list[np.ndarray]:
    """Each muscle's torque in the intervals, roughly."""
    torques = [np.zeros(grid.size) for grid in grids]
    for _ in range(PILOT_TURNS):
        before = np.stack(torques)
        for place, grid in enumerate(grids):
            own = _without(grid, sum(t for i, t in enumerate(torques) if i != place))
            found = pilot_solution(own, rows)
            size, parts = found.projection.basis.size, grid.begins.size
            kept = np.r_[np.arange(size), np.arange(size + parts, found.coefficients.size)]
            torques[place] = found.columns[:, kept] @ found.coefficients[kept]
        if np.linalg.norm(np.stack(torques) - before) <= SETTLED * np.linalg.norm(before):
            break
    return torques


def _torque_of(fitted: Fitted) -> np.ndarray:
    """A muscle's torque in the intervals with the record's sign, N·m, without its baseline."""
    problem, setup = fitted.problem, fitted.problem.setup
    mean = problem.run(fitted.theta)[0]
    return setup.sign * (mean - fitted.physical[list(problem.baselines)][setup.grid.part])


def _together(
    measured: JointRecord, record: JointRecord, grids: tuple[Grid, ...], raw: Raw, fits: Sequence[Fitted]
) -> JointFitted:
    """All muscles at once, from the fit of each."""
    first = fits[0].problem.setup
    setups = [first.with_(grid=grids[0], target_nm=first.to_muscle(grids[0].torque_nm))]
    for grid, fitted in zip(grids[1:], fits[1:], strict=True):
        setup = fitted.problem.setup
        zeros = np.zeros(grid.begins.size)
        pinned = zeros, zeros + PINNED * setup.scale_nm
        target_nm = setup.sign * (grid.torque_nm - first.zero_nm)
        own = {"zero_nm": first.zero_nm, "rests_nm": pinned, "target_nm": target_nm, "at_rest": _begins_at_rest(grid)}
        setups.append(setup.with_(grid=grid, **own))
    nothing = tuple(() for _ in fits)
    problem = assemble(setups, nothing, ())
    theta = np.concatenate([fitted.theta for fitted in fits])
    for part, place in zip(problem.parts[1:], problem.places[1:], strict=True):
        theta[place.start + np.array(part.baselines)] = 0.0
        if part.setup.at_rest:
            theta[place.start + np.array(part.initials)] = 0.0
    noise = min((fitted.noise for fitted in fits), key=lambda one: one.sd_nm)
    start = NoiseLevel(noise.ar1, 0.5, noise.sd_nm) if not noise.held else noise
    return JointFitted(record, measured, grids, raw, nothing, (), solve(problem, theta, start))


def _begins_at_rest(grid: Grid) -> bool:
    """Whether a further muscle begins without pulses: what torque there is then belongs to the first one."""
    return not np.any(grid.pulse_width_us[grid.starts] > 0)
