"""Verbs of a controller's trials: read the recording, follow the muscle, move the approved model."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.record_files import Progress, begun
from stimrig.identify.json_text import json_value

MOST_MISSED = 50
SETTLED_S = 0.2
"""So long the torque must have been measured at rest for its offset to be known."""


def track(
    data: str,
    progress: Progress,
    model_json: str,
    bounds: Mapping[str, Sequence[float]],
    state: dict[str, Any] | None = None,
    missed: int = 0,
    earlier: Sequence[Sequence[dict[str, Any]]] = (),
    reference_torque_nm: Sequence[float] | None = None,
    between: Sequence[str] = (),
) -> dict[str, Any]:
    """Follow the trial of a recording, `data`, from the approved MODEL.json.

    `bounds`: least and most that a person allowed, of each quantity that may move in the model; `state`: what was
    expected after the last trial that was followed; `missed`: trials since then, by which that is less certain;
    `earlier`: levels of the trials of earlier sessions, which say how fast they change; `reference_torque_nm`: what the
    controller wanted, one value for each pulse, N·m; `between`: recordings of what the muscle did since `state`, or
    since the begin of the approved model's test, oldest first, for effects with slow states, such as fatigue.

    Returns `error_percent`, None without a reference; `step` and the text of the `model` for the next trial, or the
    `reason` why the trial was not followed.
    """
    from stimrig.identify.tracking.follow import begin, follow, model_for_next, passed, slow_forms
    from stimrig.identify.tracking.state import State, learn_rates

    progress(0.1, "reading the recording")
    record = dated(Path(data))
    error = error_percent(record, reference_torque_nm)
    try:
        model, rates = second_order(model_json), learn_rates(earlier)
        before = begin(model, rates) if state is None else State.from_dict(state)
        for _ in range(min(missed, MOST_MISSED)):
            before = before.predicted(rates)
        for path in between if slow_forms(model) else ():
            with contextlib.suppress(identify.IdentifyError, OSError):  # one that cannot be read is left out
                before = passed(model, before, dated(Path(path)))
        step = follow(model, before, record, rates)
        moved = model_for_next(model, step, bounds)
    except identify.IdentifyError as problem:
        return {"error_percent": error, "reason": " ".join(str(problem).split())}
    document = json_value(step.to_dict()) | {"moved": list(bounds)}
    return {"error_percent": error, "step": document, "model": moved.to_json(None)}


def dated(path: Path) -> Any:
    """Read a recording that knows when it began, if its file says so."""
    record = identify.read(path)
    part = record.parts[0]
    if len(record.parts) > 1 or part.begun_s is not None:
        return record
    return replace(record, parts=(replace(part, own_s=float(record.time_s[0]), begun_s=begun(path)),))


def second_order(model_json: str) -> Any:
    """Return the model. Raises BadModel: its dynamics are not of second order, so it cannot be followed."""
    from stimrig.identify.dynamics.linear import SecondOrder

    model = identify.Model.from_json(model_json)
    if not isinstance(model.linear, SecondOrder):
        message = "a model whose dynamics are not of second order cannot be tracked"
        raise identify.BadModel(message, fix="Fit with maximum-likelihood.")
    return model


def error_percent(record: Any, reference_torque_nm: Sequence[float] | None) -> float | None:
    """Return the root mean square of reference minus torque, % of the reference's; None without one.

    The torque is its mean in each pulse's period, above the rest before the first pulse.
    """
    reference = np.asarray(reference_torque_nm or [], float)
    size_nm = float(np.sqrt(np.mean(reference**2))) if reference.size else 0.0
    time_s, torque_nm = record.time_s, record.torque_nm
    period = np.floor(time_s * record.pulse_rate_hz + 1e-6).astype(int)
    inside = (period >= 0) & (period < reference.size) & np.isfinite(torque_nm)
    count = np.bincount(period[inside], minlength=reference.size)
    if not size_nm > 0.0 or not count.any():
        return None
    pulses = np.flatnonzero(record.pulse_width_us > 0.0)
    rest = slice(0, pulses[0] if pulses.size else time_s.size)
    settled = time_s[rest].size > 1 and time_s[rest][-1] - time_s[rest][0] >= SETTLED_S
    offset_nm = float(np.mean(torque_nm[rest])) if settled else 0.0
    measured = count > 0
    mean_nm = np.bincount(period[inside], torque_nm[inside], reference.size)[measured] / count[measured]
    return float(100.0 * np.sqrt(np.mean((reference[measured] - (mean_nm - offset_nm)) ** 2)) / size_nm)


def track_warm(progress: Progress, model_json: str) -> dict[str, Any]:
    """Load all that `track` needs, and follow two seconds of the model's own torque: then a trial waits for nothing."""
    from stimrig.identify.tracking import follow, model_for_next

    progress(0.1, "loading")
    importlib.import_module("h5py")
    with contextlib.suppress(identify.IdentifyError):  # what cannot be followed is said after the first trial
        model = second_order(model_json)
        time_s = np.arange(800) / 400.0
        widths_us = np.where((time_s > 0.5) & (time_s < 1.2), 0.7 * model.recruitment.basis.largest_us, 0.0)
        rate = {"pulse_rate_hz": model.pulse_rate_hz}
        empty = identify.Record.from_arrays(time_s, widths_us, np.zeros(time_s.size), **rate)
        step = follow(model, None, empty.with_torque(identify.predict(model, empty)))
        model_for_next(model, step).to_json(None)
    return {}
