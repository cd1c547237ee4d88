"""Models with effects: fit any set of them, predict, warm up the compiled parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identify.dynamics.pulse_grid import make_grid
from identify.effects import get, registry
from identify.errors import BadRequest, NotIdentifiable
from identify.estimation.joint import Fitted, solve, start_from
from identify.estimation.prepare import inspect, prepare
from identify.estimation.statistics import figures
from identify.estimation.to_model import predict, to_model
from identify.model import Model
from identify.noise.level import find_band
from identify.records.record import Record
from identify.simulation.problem import Problem

PATIENCE = 2
"""Steps of a chain of forms without a gain after which it ends."""


def fit_with_effects(record: Record, effects: Sequence[str], fit_on: Sequence[str] | None = None) -> Model:
    """A Hammerstein model with the effects named, each in its likeliest form.

    Parameters
    ----------
    record : Record
        Pulse widths and torque.
    effects : sequence of str
        Ids, or "id:form" to settle the form.
    fit_on : sequence of str or None
        Segments to fit on; all but `validate` by default.

    Raises
    ------
    BadRequest
        An unknown effect, form or segment.
    NotIdentifiable
        An effect needs a column that the record lacks, or isn't there to be started from.
    """
    fitted = fit_candidate(record, effects, fit_on)
    return to_model(fitted, record, figures(fitted, record))


def fit_candidate(record: Record, effects: Sequence[str], fit_on: Sequence[str] | None = None) -> Fitted:
    """As `fit_with_effects`, with all that the engine knows of the fit."""
    rows = _rows(record, fit_on)
    raw = inspect(record)
    _setup, current = prepare(record, raw, rows)
    for name in effects:
        identifier, _, wanted = name.partition(":")
        effect = get(identifier)
        for need in effect.needs:
            if getattr(record, need) is None:
                raise NotIdentifiable(f"{identifier} needs the column {need}", place=need, mend="Record it.")
        try:
            forms = [effect.form(wanted)] if wanted else list(effect.forms)
        except KeyError as error:
            raise BadRequest(f"{identifier} has no form {wanted!r}") from error
        current = _add(current, identifier, forms, raw.hum if identifier == "mains_hum" else None)
    return current


def _add(base: Fitted, identifier: str, forms: list, known: dict[str, float] | None) -> Fitted:
    setup = base.problem.setup
    if get(identifier).band:
        return solve(base.problem, base.theta, find_band(base.residual_nm, setup.stretches, setup.grid.step_s)[0])
    best: Fitted | None = None
    previous: dict[str, float] = {}
    residual, idle, top_gain = base.residual_nm, 0, -np.inf
    for form in forms:
        if not form.grows:  # the first of a chain: what comes before says nothing of it
            previous, residual, idle, top_gain = {}, base.residual_nm, 0, -np.inf
        elif idle >= PATIENCE:
            continue
        problem = Problem(setup, [*base.effects, (identifier, form)])
        starts = [known] if known else form.starts(setup.scene)
        if form.propose is not None:
            found = form.propose(np.where(setup.fitted, residual, np.nan), setup.scene, previous)
            starts = found or [{p.name: p.neutral for p in form.parameters}]
        runs = [solve(problem, start_from(problem, base, {len(base.effects): s}), base.noise) for s in starts]
        runs = [r for r in runs if form.accept is None or form.accept(r.parameters_of(identifier), setup.scene)] or runs
        top = max(runs, key=lambda f: f.log_evidence)
        gain = top.log_evidence - base.log_evidence
        idle, top_gain = (0, gain) if gain > max(top_gain, 0.0) else (idle + 1, top_gain)
        if form.propose is not None:
            previous, residual = top.parameters_of(identifier), top.residual_nm
        if best is None or top.log_evidence > best.log_evidence:
            best = top
    assert best is not None
    return best


def _rows(record: Record, fit_on: Sequence[str] | None) -> np.ndarray | None:
    if fit_on is None:
        return None
    unknown = [name for name in fit_on if name not in record.segment_names]
    if unknown:
        known = ", ".join(dict.fromkeys(record.segment_names))
        raise BadRequest(f"no segment is called {unknown[0]!r}", place="fit_on", mend=f"Known: {known}.")
    grid = make_grid(record)
    names = np.array(record.segment_names)[grid.segment]
    rows = grid.fitted & np.isin(names, list(fit_on))
    if rows.sum() < 40:
        raise NotIdentifiable("less than a second to fit on", place="fit_on", mend="Name longer segments.")
    return rows


def warm() -> None:
    """Compile (or load from the cache) what is compiled, on a second of made-up data."""
    time_s = np.arange(400) / 100.0
    width = np.where((np.floor(time_s * 4) % 2) == 1, 200.0, 0.0)
    torque = np.convolve(width / 100.0, np.exp(-np.arange(40) / 10.0) / 10.0)[:400]
    record = Record.from_arrays(time_s, width, torque + 0.01 * np.sin(37.0 * np.arange(400) ** 1.3))
    base = fit_candidate(record, [])
    setup = base.problem.setup
    find_band(base.residual_nm, setup.stretches, setup.grid.step_s)
    for effect in registry().values():
        if effect.needs or effect.raw or effect.band:
            continue
        for form in effect.forms[:6] if effect.foreseeable else effect.forms[:1]:
            problem = Problem(setup, [(effect.id, form)])
            problem.run(start_from(problem, base, {0: form.starts(setup.scene)[0]}), derivatives=True)


__all__ = ["Fitted", "fit_candidate", "fit_with_effects", "predict", "to_model", "warm"]
