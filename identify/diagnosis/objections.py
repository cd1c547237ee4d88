"""What speaks against naming an effect that the evidence asks for."""

from __future__ import annotations

import numpy as np

from stimrig.identify.diagnosis.residual import vetoed
from stimrig.identify.diagnosis.search import Step
from stimrig.identify.diagnosis.thresholds import SHORTEST_WAVE_S
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.solve import Fitted

AT_BOUND = 1e-3
"""Part of the range of a parameter in which it counts as being at its bound."""
IN_TIME = 0.6
"""Share of the large changes of the pulse width that come at a fixed clock, as in a PRBS."""
LARGE = 0.2
"""A change above this share of the largest one is large; those of ramps are not."""
CLOCK_HZ = 0.2
"""A wave so near a multiple of that clock has its frequency."""


def objection_to(before: Step, step: Step) -> str | None:
    """Return what speaks against the effect of a step, in words; None if nothing does."""
    effect, fitted = find_effect(str(step.added)), step.searched
    grid = fitted.problem.setup.grid
    if objection := vetoed(before.searched, fitted):
        return objection
    if not effect.band:
        ends = at_bounds(fitted, effect.id)
        return f"At the bound of what is tried: {', '.join(ends)}. Another effect may fit better." if ends else None
    if fitted.noise.band_s(grid.step_s) < SHORTEST_WAVE_S:
        return "Its wave dies away so soon that the pulses may set it off: a limb may swing."
    hz = fitted.noise.turn / (2.0 * np.pi * grid.step_s)
    if _keeps_time(hz, grid):
        return f"Its frequency, {hz:.3g} Hz, is that at which the pulse width changes: the pulses may cause it."
    return None


def at_bounds(fitted: Fitted, effect: str) -> list[str]:
    """Return the parameters of an effect that lie at a bound of what is tried, in words."""
    ends: dict[str, None] = {}
    for chosen in fitted.problem.chosen:
        if chosen.effect != effect or chosen.form.fixed:
            continue
        for place, p in zip(chosen.places, chosen.parameters, strict=True):
            numbers = fitted.physical[place], p.lower, p.upper
            value, low, high = np.log(numbers) if p.scale == "log" else numbers
            if not AT_BOUND < (value - low) / (high - low) < 1.0 - AT_BOUND:
                ends[f"{p.about or p.name} {numbers[0]:.3g}{f' {p.unit}' if p.unit != '1' else ''}"] = None
    return list(ends)


def _keeps_time(wave_hz: float, grid: Grid) -> bool:
    """Return True if the pulse widths change at a fixed clock, and a wave has its frequency or a multiple of it."""
    steps_us = np.abs(np.diff(grid.pulse_width_us))
    apart = np.diff(np.flatnonzero(steps_us > LARGE * np.max(steps_us, initial=0.0)))
    longest = int(np.bincount(apart).argmax()) if apart.size else 0
    clock = next((steps for steps in range(longest, 1, -1) if np.mean(apart % steps == 0) > IN_TIME), 0)
    turns = wave_hz * clock * grid.step_s
    return bool(turns > 0.5 and abs(turns - round(turns)) < CLOCK_HZ * clock * grid.step_s)
