"""Free-run prediction: from the recorded pulse widths alone, at the record's own rate."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from identify.dynamics import narx
from identify.dynamics.linear import Discrete, Linear, SecondOrder
from identify.dynamics.pulse_grid import Grid, make_grid
from identify.effects import get
from identify.errors import BadModel
from identify.records.record import Record
from identify.recruitment.curve import Curve
from identify.simulation.problem import Problem
from identify.simulation.setup import Setup

LARGEST_RATE_CHANGE = 0.25


class Muscle(Protocol):
    """What of a model its simulation needs."""

    @property
    def recruitment(self) -> Curve: ...

    @property
    def linear(self) -> Linear: ...

    @property
    def pulse_rate_hz(self) -> float: ...

    @property
    def baseline_nm(self) -> float: ...

    @property
    def initial(self) -> tuple[float, float]: ...

    @property
    def effects(self) -> tuple[dict[str, Any], ...]: ...

    @property
    def data(self) -> dict[str, Any]: ...

    @property
    def extra(self) -> dict[str, Any]: ...


def predict(model: Muscle, record: Record) -> np.ndarray:
    """Torque the model gives for the record's pulse widths, N·m, shape (N,).

    No measured torque is used: this is what the controller would have seen. What can't be foreseen (bumps, tremor) is
    given back on the rows that it was fitted on alone.

    Raises
    ------
    BadModel
        The pulse rate is another, an effect or its form is unknown here, or the record lacks a column that it needs.
    """
    refuse_rate(model, record)
    return predict_on(model, make_grid(record))


def predict_on(model: Muscle, grid: Grid) -> np.ndarray:
    """As `predict`, for a grid that is already made."""
    if isinstance(model.linear, Discrete):
        if model.extra.get("narx"):
            return narx.at_samples(model.extra["narx"], grid, model.linear.centre)
        return model.linear.at_samples(grid, model.recruitment(grid.pulse_width_us)) + model.baseline_nm
    problem, theta = problem_of(model, grid)
    unforeseen = frozenset(e["id"] for e in model.effects if not get(e["id"]).foreseeable)
    foreseen = problem.at_samples(theta, unforeseen)
    if not unforeseen or not same_data(model, grid.record):
        return foreseen
    return np.where(grid.record.held_out, foreseen, problem.at_samples(theta))


def problem_of(model: Muscle, grid: Grid) -> tuple[Problem, np.ndarray]:
    """The problem whose solution a model is, on another record, and its parameters there.

    Raises
    ------
    BadModel
        As `predict`.
    """
    if not isinstance(model.linear, SecondOrder):
        raise BadModel("effects stand on a second order only", mend="Fit with maximum-likelihood.")
    settings = model.effects[0].get("settings", {}) if model.effects else {}
    setup = Setup(
        grid=grid,
        target_nm=np.zeros(grid.size),
        fitted=grid.fitted,
        basis=model.recruitment.basis,
        roughness=np.zeros((model.recruitment.basis.size,) * 2),
        scale_nm=float(settings.get("scale_nm", 1.0)),
        noise_sd_nm=float(settings.get("noise_sd_nm", 0.0)),
        delay_bounds_s=(-math.inf, math.inf),
        zero_nm=float(settings.get("zero_nm", 0.0)),
        sign=float(settings.get("sign", 1.0)),
        reference_s=float(settings.get("reference_s", 0.0)),
    )
    effects, parameters = [], []
    for entry in model.effects:
        try:
            effect = get(entry["id"])
            form = effect.form(entry.get("form", ""))
            parameters += [float(_value(entry["parameters"][p.name])) for p in form.parameters]
        except Exception as error:
            raise BadModel(f"{error}", place=f"effects.{entry.get('id')}", mend="Install the effect's file.") from error
        for need in effect.needs:
            if getattr(grid.record, need) is None:
                raise BadModel(f"{effect.id} needs the column {need}", place=need, mend="Record it, or leave it out.")
        effects.append((effect.id, form))
    problem = Problem(setup, effects)
    values = np.zeros(problem.size)
    values[:3] = model.linear.time_constant_s, model.linear.damping, model.linear.delay_s
    values[list(problem.baselines)] = setup.framed(np.asarray(model.baseline_nm))
    if same_data(model, grid.record):
        parts = np.asarray(model.extra.get("parts", [[model.baseline_nm, *model.initial]]))[: grid.starts.size]
        values[np.array(problem.baselines)[grid.part[grid.starts[: len(parts)]]]] = setup.framed(parts[:, 0])
        values[list(problem.initials)[: 2 * len(parts)]] = setup.sign * parts[:, 1:].ravel()
    values[problem.coefficients] = setup.sign * model.recruitment.coefficients_nm
    values[problem.coefficients.stop :] = parameters
    return problem, problem.from_physical(values)


def slopes(model: Muscle, grid: Grid, names: Sequence[str]) -> np.ndarray:
    """Derivatives of each interval's mean torque by named parameters of the model, shape (K, len(names)).

    On another record the beginning of the model's own does not matter, and its baseline holds for all parts.
    """
    problem, theta = problem_of(model, grid)
    jacobian = problem.run(theta, derivatives=True)[1]
    assert jacobian is not None
    # In the record's own sign the parameters in N·m turn with the torque: the same derivative.
    turned = np.ones(problem.size)
    turned[:3] = problem.setup.sign
    turned[problem.coefficients.stop :] = problem.setup.sign
    jacobian = jacobian * (turned / np.where(problem.log, problem.physical(theta), 1.0))[:, None]
    if not same_data(model, grid.record):
        jacobian[problem.baselines.start] = jacobian[list(problem.baselines)].sum(axis=0)
        jacobian[problem.baselines.start + 1 : problem.initials.stop] = 0.0
    place = {name: at for at, name in enumerate(problem.names)}
    found = np.zeros((grid.size, len(names)))
    for column, name in enumerate(names):
        if name in place:
            found[:, column] = jacobian[place[name]]
    return found


def refuse_rate(model: Muscle, record: Record) -> None:
    """Refuse a record of a pulse rate for which the model says nothing.

    Raises
    ------
    BadModel
    """
    if not abs(record.pulse_rate_hz / model.pulse_rate_hz - 1.0) <= LARGEST_RATE_CHANGE:
        raise BadModel(
            f"the model holds for {model.pulse_rate_hz:g} pulses a second, the record has {record.pulse_rate_hz:g}",
            place="pulse_rate_hz",
            mend="Fit a model at that rate.",
        )


def _value(entry: Any) -> float:
    return entry["value"] if isinstance(entry, dict) else entry


def same_data(model: Muscle, record: Record) -> bool:
    """Whether the record is the very one that the model was fitted on."""
    return bool(model.data.get("fingerprint")) and model.data["fingerprint"] == fingerprint(record)


def fingerprint(record: Record) -> str:
    """SHA-256 of time since the record's start, to the microsecond, of pulse width and of torque."""
    digest = hashlib.sha256()
    own_us = np.round(1e6 * (record.time_s - record.time_s[0])).astype(np.int64)
    for column in (own_us, record.pulse_width_us, record.torque_nm):
        digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()
