"""Free-run prediction: from the recorded pulse widths only, at the record's samples."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from stimrig.identify import model_schema
from stimrig.identify.dynamics.grid import Grid, make_grid
from stimrig.identify.dynamics.linear import Discrete, SecondOrder, run_narx
from stimrig.identify.effects import find_effect
from stimrig.identify.effects.base import Form, replaced_by
from stimrig.identify.errors import BadModel, BadRequest, RunsAway
from stimrig.identify.problem.joint_surface import JointEffect, Surfaces
from stimrig.identify.problem.problem import Problem
from stimrig.identify.problem.setup import SETTINGS, Setup
from stimrig.identify.records.joint_motion import JointMotion
from stimrig.identify.records.record import Record

if TYPE_CHECKING:  # a model predicts by this module
    from stimrig.identify.model import Model

LARGEST_RATE_CHANGE = 0.25
GROWN, LEAST_USUAL_NM = 1e6, 1.0
"""A prediction beyond so many times the usual torque, recruited or at rest, is no torque."""
MOVES_RAD = 0.1
"""Smallest range of the angle in an earlier trial: a smaller one shows the sensor's noise, not the movement."""


def predict(model: Model, record: Record, earlier_trial: Record | None = None) -> np.ndarray:
    """Torque that the model predicts for the record's pulse widths, N·m, shape (N,).

    No measured torque is used: a controller would predict the same. The angle is smoothed both ways, as a whole record
    is there; with an `earlier_trial` of the same movement from what was read until the end of the pulse interval alone,
    as a controller has it while the joint moves: the earlier trial shows how noisy the sensor is and how the joint
    moves in general; it serves no other purpose. Torque that cannot be predicted (`unpredictable_torque`) is included
    only on the rows that it was fitted on.

    Raises BadModel: the pulse rate differs too much, an effect or its form is unknown here, the record lacks a column
    it needs, or the torque grows without limit. Raises BadRequest: in the earlier trial no joint moves, or it is
    several recordings.

    Parameters
    ----------
    model : Model
        The model.
    record : Record
        Its pulse widths and, for a joint that moves, its angle.
    earlier_trial : Record, optional
        The same movement before.
    """
    refuse_rate(model, record)
    grid = make_grid(record)
    if earlier_trial is None or record.angle_rad is None or isinstance(model.linear, Discrete):
        return _refuse_runaway(model, record, predict_on(model, grid))
    if len(earlier_trial.parts) > 1:
        raise BadRequest("the earlier trial is several recordings", fix="Give one of them.")
    read_rad = np.full(1, np.nan) if earlier_trial.angle_rad is None else earlier_trial.angle_rad
    known_rad = read_rad[np.isfinite(read_rad)]  # of most readings, nine tenths of which span a movement
    if known_rad.size <= 0.5 * read_rad.size or np.ptp(np.percentile(known_rad, (5.0, 95.0))) <= MOVES_RAD:
        raise BadRequest("in the earlier trial no joint moves", fix="Give a trial of the same movement and sensor.")
    problem, theta = problem_of(model, grid)
    first = [part.first for part in record.parts]
    earlier_movement = earlier_trial.time_s, read_rad
    motion = JointMotion.until_then(record.time_s, record.angle_rad, first, earlier_movement)
    moved = _moved(problem, motion.extrapolated(problem.setup.angle_late_s), angle_late_s=0.0)
    return _refuse_runaway(model, record, _predict_samples(model, record, moved, theta))


def _refuse_runaway(model: Model, record: Record, torque_nm: np.ndarray) -> np.ndarray:
    """The same torque. Raises RunsAway where it is none: rates that switch can make it grow without limit."""
    widths_us = np.unique(record.pulse_width_us)
    usual_nm = max(float(np.max(np.abs(model.recruitment(widths_us)))), abs(model.baseline_nm), LEAST_USUAL_NM)
    if not np.max(np.abs(torque_nm), initial=0.0) <= GROWN * usual_nm:
        raise RunsAway("the torque that it predicts grows without limit", fix="Do not use this model; fit another one.")
    return torque_nm


def _moved(problem: Problem, motion: JointMotion, **changes: float) -> Problem:
    return Problem(problem.setup.with_(motion=motion, **changes), problem.effects)


def predict_on(model: Model, grid: Grid) -> np.ndarray:
    """As `predict`, for a record on its grid."""
    if isinstance(model.linear, Discrete) and not model.effects:
        linear, widths_us, narx = model.linear, grid.pulse_width_us, model.extra.get("narx")
        if narx:
            return linear.between(grid, run_narx(narx, grid.interval_means(widths_us)) + narx["baseline_nm"])
        return linear.between(grid, linear.on_grid(grid, model.recruitment(widths_us))) + model.baseline_nm
    return _predict_samples(model, grid.record, *problem_of(model, grid))


def _predict_samples(model: Model, record: Record, problem: Problem, theta: np.ndarray) -> np.ndarray:
    """Torque at the samples; on held-out pulses of its own record without what cannot be foreseen."""
    whole, unpredictable = problem.at_samples(theta), unpredictable_torque(model)
    if not unpredictable or not same_data(model, record):
        return whole
    zero_nm = sum(mean for mean, _ in unpredictable.values())
    predictable_nm = problem.at_samples(theta, frozenset(unpredictable)) + zero_nm
    return np.where(record.held_out, predictable_nm, whole)


def unpredictable_torque(model: Model) -> dict[str, tuple[float, float]]:
    """Return the torque of each effect that cannot be predicted on another record: mean and root mean square, N·m.

    Both are taken over the fitted rows of the model's own record. The mean stays as a zero.
    """
    unpredictable = [entry for entry in model.effects if not find_effect(entry["id"]).predictable]
    return {
        e["id"]: tuple(e.get("unforeseen", {}).get(key, 0.0) for key in ("mean_nm", "rms_nm")) for e in unpredictable
    }


def problem_of(
    model: Model, grid: Grid, further: Sequence[tuple[Form, Sequence[float]]] = ()
) -> tuple[Problem, np.ndarray]:
    """The model as a `Problem` on a record, and its parameters there; on another record than its own without effects
    that cannot be foreseen.

    `further`: forms that act beside the model's effects, next to the curve (a gain before all others, what changes the
    widths after them), and the values of their parameters.

    Raises BadModel: as `predict`.
    """
    if not isinstance(model.linear, SecondOrder):
        raise BadModel("only second-order dynamics can have effects", fix="Fit with maximum-likelihood.")
    settings: dict[str, Any] = model.effects[0]["settings"] if model.effects else {"scale_nm": 1.0}
    Surfaces.of(model.effects)  # refuses a model of a moving joint that does not say at which angles it holds
    own_record, baseline_nm = same_data(model, grid.record), model.baseline_nm
    setup = Setup(
        grid=grid,
        target_nm=np.zeros(grid.size),
        fitted=grid.fitted,
        basis=model.recruitment.basis,
        delay_bounds_s=(-math.inf, math.inf),
        states={} if own_record else states_of(model),
        # as floats: kernels would be compiled anew for the whole numbers that JSON may hold
        **{name: np.array(settings[name], float).tolist() for name in SETTINGS if name in settings},
    )
    acting = [(form.name, form, values) for form, values in further if form.stage == "gain"]
    for entry in model.effects:
        joint_effect = JointEffect.of(entry)
        if not joint_effect.effect.predictable and not own_record:
            baseline_nm += entry.get("unforeseen", {}).get("mean_nm", 0.0)
            continue
        for need in joint_effect.effect.needs:
            if not grid.record.knows(need):
                fix = "Record this column, or fit without the effect."
                raise BadModel(f"{joint_effect.effect.id} needs the column {need}", place=need, fix=fix)
        acting.append((joint_effect.effect.id, joint_effect.form, [*joint_effect.values.values()]))
    acting += [(form.name, form, values) for form, values in further if form.stage != "gain"]
    _refuse_ignored([(name, form) for name, form, _ in acting])
    problem = Problem(setup, [(name, form) for name, form, _ in acting])
    values = np.zeros(problem.size)
    values[:3] = model.linear.time_constant_s, model.linear.damping, model.linear.delay_s
    values[list(problem.baselines)] = setup.to_muscle(np.asarray(baseline_nm))
    if own_record:
        parts = np.asarray(model.extra.get("parts", [[model.baseline_nm, *model.initial]]))[: grid.starts.size]
        values[np.array(problem.baselines)[grid.part[grid.starts[: len(parts)]]]] = setup.to_muscle(parts[:, 0])
        values[list(problem.initials)[: 2 * len(parts)]] = setup.sign * parts[:, 1:].ravel()
    values[problem.coefficients] = setup.sign * model.recruitment.coefficients_nm
    values[problem.coefficients.stop :] = [value for *_, form_values in acting for value in form_values]
    return problem, problem.from_physical(values)


def _refuse_ignored(acting: Sequence[tuple[str, Form]]) -> None:
    """Refuse an effect that stands twice, or of which another would take the place."""
    for number, (name, form) in enumerate(acting):
        other = name if name in dict(acting[:number]) else replaced_by(acting[:number], [form])
        if other is not None:
            message = "it stands twice" if other == name else f"{other} already sets the lags"
            raise BadModel(message, place=f"effects, {name}", fix="Leave one of them out, and fit again.")


def sensor_cost_nm(problem: Problem, theta: np.ndarray) -> float:
    """Standard deviation of the torque owing to the angle's error, N·m: of the same movement, read another time."""
    grid = problem.setup.grid
    record, difference_nm = grid.record, 0.0
    if record.motion is not None:
        motion = record.motion.read_again(record.time_s, [part.first for part in record.parts])
        difference_nm = (_moved(problem, motion).run(theta)[0] - problem.run(theta)[0])[grid.comparable]
    return float(np.sqrt(np.mean(np.square(difference_nm))))


def states_of(model: Model) -> dict[str, float]:
    """By effect id, where its slow state is at the begin of what is predicted; rested effects need not be there.

    Raises BadModel: a state is not a number from 0 to 1.
    """
    states = {entry["id"]: entry["state"] for entry in model.effects if "state" in entry}
    for effect, value in states.items():
        model_schema.check(value, model_schema.STATE, f"effects.{effect}.state")
    return states


def slopes(model: Model, grid: Grid, names: Sequence[str]) -> np.ndarray:
    """Derivatives of each interval's mean torque by named parameters of the model, shape (K, len(names)).

    On another record than the fitted one, the initial state is zero and one baseline holds for all parts.
    """
    problem, theta = problem_of(model, grid)
    jacobian = problem.run(theta, derivatives=True)[1]
    assert jacobian is not None
    # With the record's sign, parameters in N·m change sign as the torque does: their derivative stays the same.
    turned = np.ones(problem.size)
    turned[:3] = problem.setup.sign
    turned[problem.coefficients.stop :] = problem.setup.sign
    jacobian = jacobian * (turned / np.where(problem.log, problem.physical(theta), 1.0))[:, None]
    if not same_data(model, grid.record):
        jacobian[problem.baselines.start] = jacobian[list(problem.baselines)].sum(axis=0)
        jacobian[problem.baselines.start + 1 : problem.initials.stop] = 0.0
    known = dict(zip(problem.names, jacobian, strict=True))
    return np.stack([known.get(name, np.zeros(grid.size)) for name in names], axis=1)


def refuse_rate(model: Model, record: Record) -> None:
    """Refuse a record whose pulse rate is outside the model's range.

    Raises BadModel: the rates differ by more than 25 %.
    """
    if not abs(record.pulse_rate_hz / model.pulse_rate_hz - 1.0) <= LARGEST_RATE_CHANGE:
        raise BadModel(
            f"the model holds for {model.pulse_rate_hz:g} pulses a second, the record has {record.pulse_rate_hz:g}",
            place="pulse_rate_hz",
            fix="Fit a model at that rate.",
        )


def same_data(model: Model, record: Record) -> bool:
    """Return True if the record is the one that the model was fitted on."""
    return bool(model.data.get("fingerprint")) and model.data["fingerprint"] == fingerprint(record)


def fingerprint(record: Record) -> str:
    """SHA-256 of time since the record's start, to the microsecond, of pulse width and of torque."""
    digest = hashlib.sha256()
    own_us = np.round(1e6 * (record.time_s - record.time_s[0])).astype(np.int64)
    for column in (own_us, record.pulse_width_us, record.torque_nm):
        digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()
