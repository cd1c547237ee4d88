"""The next experiment: the shortest test, among those that the rig can do, that separates rival effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import ends_of, make_grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.experiments.designs import Design, designs, held_levels
from stimrig.identify.noise import whitened
from stimrig.identify.problem.problem import Problem
from stimrig.identify.records.record import Record
from stimrig.identify.results import Result
from stimrig.identify.summary import Sheet

__all__ = ["Experiment"]

ENOUGH = 7.0
"""Expected log evidence that is enough to decide: odds of about 1000 to 1."""
PER_PULSE = 4
"""Samples per pulse of the simulated test."""
SEED, REFERENCE = 7, 8
"""Seeds of the levels of designs, and of those on which they are compared: their own would speak for them."""
NOTHING = "nothing"
"""The name of a model without effects, as a rival."""


@dataclass(frozen=True, repr=False, eq=False)
class Experiment(Result):
    """A test that tells rival effects apart."""

    rivals: tuple[str, ...]  # ids of the effects
    segments: tuple[Mapping[str, Any], ...]  # `name`, `sequence`, `settings` of each, as `POST /v1/tests` takes them
    duration_s: float  # of the whole test
    dose: Mapping[str, float]  # `pulses`, `pulse_width_sum_us` and `torque_time_nm_s`
    expected_log_evidence: float  # how clearly the test is expected to decide: of the pair with the smallest
    decides: bool  # whether that is enough
    text: str  # the test in one sentence
    expected_fall: float | None = None  # share by which the model's own standard error is expected to fall, if asked

    def _sheet(self) -> Sheet:
        rows = [("test", self.text), ("pulses", f"{self.dose['pulses']:.0f}")]
        for segment in self.segments:
            settings = ", ".join(f"{key} {_short(value)}" for key, value in segment["settings"].items())
            rows.append((str(segment["name"]), f"{segment['sequence']}: {settings}"))
        about = " or ".join(self.rivals) or "what is left"
        return Sheet(f"Next experiment: {about}, {self.duration_s:.0f} s", tuple(rows))


def _short(value: Any) -> str:
    return f"{len(value)} values" if isinstance(value, list | tuple) else str(value)


def plan(record: Record, fits: Mapping[str, Fitted]) -> Experiment:
    """The shortest test that separates rivals, each simulated as it was fitted to a record that does not.

    `fits`: by effect id, or `NOTHING`.
    """
    largest_us = float(record.pulse_width_us.max())
    tests = [(design, design.pulse_widths(record.pulse_rate_hz)) for design in designs(largest_us)]
    gains = [expected_log_evidence(width, record, fits) for _, width in tests]
    # the shortest of those that decide; if none does, the one with the largest gain for its length
    decides = max(gains) >= ENOUGH
    best = max(range(len(tests)), key=lambda n: (gains[n] >= ENOUGH, (1.0 if decides else gains[n]) / tests[n][1].size))
    names, gain = tuple(name for name in fits if name != NOTHING), gains[best]
    played = _played(*tests[best], record, next(iter(fits.values())))
    those = " from ".join([*(find_effect(name).name.lower() for name in names[:2]), "no effect"][:2])
    test = f"{tests[best][0].words} ({played[1]:.0f} s)"
    text = f"{test} should separate {those}: expected log evidence {gain:.0f}."
    if not decides:
        lacking = f"expected log evidence {gain:.1f}; at least {ENOUGH:g} is required"
        text = f"{test} is the best test to separate {those}, but it may not be enough: {lacking}."
    return Experiment(names, *played, gain, decides, text)


def plan_further(record: Record, fitted: Fitted, rivals: Sequence[Fitted] = ()) -> Experiment:
    """The test that teaches a model most, where structure is left that no effect of the library explains.

    Held random levels, in the design that separates the model best from its rivals; without rivals, in that after which
    the model's own standard error on other such levels is smallest. Jumps of level while stimulated are what the
    paper's test lacks. A further ramp alone taught muscles of other physics nothing.

    `fitted`: the last model; `rivals`: models with another last term that predict left-out parts as well.
    """
    rate_hz, largest_us = record.pulse_rate_hz, float(record.pulse_width_us.max())
    # the smallest width with a tenth of the largest torque
    widths_us = np.linspace(0.0, fitted.problem.setup.basis.largest_us, 201)
    torque_nm = np.abs(_steady_nm(fitted, widths_us))
    threshold_us = float(widths_us[np.argmax(torque_nm >= 0.1 * torque_nm.max())])
    chosen, others = (held_levels(largest_us, threshold_us, rate_hz, seed) for seed in (SEED, REFERENCE))
    tests = [(design, design.pulse_widths(rate_hz)) for design in chosen]
    played_us = np.concatenate([design.pulse_widths(rate_hz) for design in others])
    reference = _simulate(fitted, _blank(record, played_us))[1]

    def error_nm(information: np.ndarray | float) -> float:
        """Standard error of the model on the reference, N·m, once it knows so much more."""
        solution = np.linalg.lstsq(fitted.hessian + information, reference, rcond=None)[0]
        return float(np.sqrt(max(np.mean(np.sum(reference * solution, axis=0)), 0.0)))

    after = []
    for _, width in tests:
        white = _whitened(_simulate(fitted, _blank(record, width))[1], fitted)
        after.append(error_nm(white @ white.T))
    fits = {model.effects[-1][0]: model for model in (fitted, *rivals)} if rivals else {}
    gains = [expected_log_evidence(width, record, fits) for _, width in tests] if rivals else [0.0] * len(tests)
    best = min(range(len(tests)), key=lambda n: (-gains[n], after[n]))
    fall, played = 1.0 - after[best] / error_nm(0.0), _played(*tests[best], record, fitted)
    those = " from ".join(find_effect(name).name.lower() for name in [*fits][:2])
    teaches = f"should best separate {those} and" if rivals else "would"
    expected = f"the model's own standard error on levels is expected to fall by {100.0 * fall:.0f} %"
    text = f"{tests[best][0].words} ({played[1]:.0f} s) {teaches} teach most about what is left: {expected}."
    return Experiment((), *played, gains[best], gains[best] >= ENOUGH, text, fall)


def expected_log_evidence(width_us: np.ndarray, record: Record, fits: Mapping[str, Fitted]) -> float:
    """Log evidence by which a test of such widths separates that pair of rivals which it separates least.

    If one of a pair is true, the other is fitted again to the new test, with its fit to the old record as prior.

    `width_us`: one for each pulse of the new test; `fits`: to the old record, by effect id, or `NOTHING`.
    """
    blank, gains = _blank(record, width_us), []
    simulated = {name: _simulate(fitted, blank) for name, fitted in fits.items()}
    for truth, rival in permutations(fits, 2):
        (true_mean, _), (rival_mean, slopes) = simulated[truth], simulated[rival]
        white = _whitened(np.vstack([true_mean - rival_mean, slopes]), fits[truth])
        gap, slopes = white[0], white[1:]
        b = slopes @ gap
        gain = b @ np.linalg.lstsq(fits[rival].hessian + slopes @ slopes.T, b, rcond=None)[0]
        gains.append(max(0.5 * float(gap @ gap - gain), 0.0))
    return min(gains)


def _steady_nm(fitted: Fitted, width_us: np.ndarray) -> np.ndarray:
    return fitted.problem.setup.basis.design(width_us) @ fitted.physical[fitted.problem.coefficients]


def _played(design: Design, width_us: np.ndarray, record: Record, fitted: Fitted) -> tuple[Any, float, Any]:
    """Segments, duration, s, and dose of a test."""
    torque_nm = _steady_nm(fitted, width_us)
    dose = {
        "pulses": int(np.sum(width_us > 0)),
        "pulse_width_sum_us": float(width_us.sum()),
        "torque_time_nm_s": float(np.abs(torque_nm).sum() / record.pulse_rate_hz),
    }
    return tuple(segment.to_dict() for segment in design.segments), width_us.size / record.pulse_rate_hz, dose


def _blank(record: Record, width: np.ndarray) -> Record:
    width_us, rate_hz = np.repeat(width, PER_PULSE), record.pulse_rate_hz
    time_s, zeros = np.arange(width_us.size) / (PER_PULSE * rate_hz), np.zeros(width_us.size)
    angle = None if record.angle_rad is None else zeros + float(record.angle_rad[0])
    still = None if record.velocity_rad_s is None else zeros
    return Record.from_arrays(time_s, width_us, zeros, angle_rad=angle, velocity_rad_s=still, pulse_rate_hz=rate_hz)


def _whitened(rows: np.ndarray, fitted: Fitted) -> np.ndarray:
    return whitened(rows, ends_of([slice(0, rows.shape[1])]), fitted.noise)


def _simulate(fitted: Fitted, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Interval means of a fitted candidate on another record, without sporadic effects, and their slopes."""
    grid = make_grid(record)
    blank = {"target_nm": np.zeros(grid.size), "fitted": np.ones(grid.size, bool), "rests_nm": None}
    setup = fitted.problem.setup.with_(grid=grid, **blank)
    problem = Problem(setup, [(effect, form) for effect, form in fitted.effects if not find_effect(effect).sporadic])
    # Parameters are copied by name: the new test has one part, starts at rest, and has no sporadic effects.
    known = {name: place for place, name in enumerate(fitted.problem.names)}
    place = np.array([known[name] for name in problem.names])
    theta = fitted.theta[place]
    theta[list(problem.initials)] = 0.0
    mean, slopes = problem.run(theta, derivatives=True)
    full = np.zeros((fitted.theta.size, mean.size))
    full[place] = slopes
    return mean, full
