"""Free-run prediction: from the recorded pulse widths alone, at the record's own rate."""

from __future__ import annotations

import numpy as np

from identify.dynamics import narx
from identify.dynamics.linear import Discrete, SecondOrder
from identify.dynamics.pulse_grid import Grid, make_grid
from identify.dynamics.second_order import free_states, read_at
from identify.model import Model
from identify.records.record import Record


def predict(model: Model, record: Record) -> np.ndarray:
    """Torque the model gives for the record's pulse widths, N·m, shape (N,).

    No measured torque is used: this is what the controller would have seen. A model with effects is run by the
    engine of the effects.
    """
    from identify.estimation.quality import refuse_rate

    refuse_rate(model, record)
    if model.effects:
        from identify.estimation import to_model as engine

        return np.asarray(engine.predict(model, record))
    return predict_on(model, make_grid(record))


def predict_on(model: Model, grid: Grid) -> np.ndarray:
    """As `predict`, for a base model and a grid that is already made."""
    if model.extra.get("narx"):
        centre = model.linear.centre if isinstance(model.linear, Discrete) else 0.0
        return narx.at_samples(model.extra["narx"], grid, centre)
    torque = model.linear.at_samples(grid, model.recruitment(grid.pulse_width_us))
    if any(model.initial) and isinstance(model.linear, SecondOrder) and same_data(model, grid.record):
        torque = torque + initial_response(model.linear, grid) @ np.asarray(model.initial)
    return torque + model.baseline_nm


def initial_response(linear: SecondOrder, grid: Grid, at_samples: bool = True) -> np.ndarray:
    """Response to a unit initial torque (column 0) and a unit initial rate (column 1), undriven."""
    torque, rate = free_states(linear.time_constant_s, linear.damping, grid.step_s, grid.size)
    if not at_samples:
        return grid.block_mean(torque, rate, linear.delay_s)
    position = grid.interval + grid.fraction - linear.delay_s / grid.step_s
    return np.stack([read_at(torque[:, j], rate[:, j], position, grid.step_s) for j in range(2)], axis=1)


def same_data(model: Model, record: Record) -> bool:
    """Whether the record is the very one that the model was fitted on."""
    return bool(model.data.get("fingerprint")) and model.data["fingerprint"] == fingerprint(record)


def fingerprint(record: Record) -> str:
    """SHA-256 of time, pulse width and torque."""
    import hashlib

    digest = hashlib.sha256()
    for column in (record.time_s, record.pulse_width_us, record.torque_nm):
        digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()
