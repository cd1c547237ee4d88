"""Compile what nearly every fit and diagnosis uses, or load it from the cache, before a request needs it."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects import registry
from stimrig.identify.estimation.fit_statistics import evaluate
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import fitted_rows, prepare
from stimrig.identify.estimation.solve import start_from
from stimrig.identify.noise import find_band
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record


def warm() -> None:
    """Compile (or load from the cache), by fitting four seconds of artificial data with an angle; rare parts wait."""
    time_s = np.arange(400) / 100.0
    width = np.where((np.floor(time_s * 4) % 2) == 1, 200.0, 0.0)
    torque = np.convolve(width / 100.0, np.exp(-np.arange(40) / 10.0) / 10.0)[:400]
    noise_nm, angle_rad = 0.01 * np.sin(37.0 * np.arange(400) ** 1.3), 1.2 + 0.3 * np.sin(time_s)
    record = Record.from_arrays(time_s, width, torque + noise_nm, angle_rad=angle_rad)
    grid, _ = prepare(record)
    base = fit_plain(grid, fitted_rows(grid, None))
    setup = base.problem.setup
    evaluate(base)
    find_band(base.residual_nm, setup.stretches, setup.grid.step_s)
    for effect in registry().values():
        if effect.detect is not None or effect.band:
            continue
        for form in effect.forms[:6] if not effect.sporadic else effect.forms[:1]:
            problem = Problem(setup, [(effect.id, form)])
            problem.run(start_from(problem, base, {0: form.starts(setup.scene)[0]}), derivatives=True)


if __name__ == "__main__":
    warm()
