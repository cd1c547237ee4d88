"""The next experiment: the shortest test, among those that the rig can do, that separates rival effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import ends_of, make_grid
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.experiments.designs import Design, designs, held_levels
from stimrig.identify.noise import whitened
from stimrig.identify.records.record import Record
from stimrig.identify.results import Result
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.summary import Sheet

ENOUGH = 7.0
"""Expected log evidence that is enough to decide: odds of about 1000 to 1."""
PER_PULSE = 4
"""Samples per pulse of the simulated test."""
REFERENCE = 8
"""Seed of the levels on which designs are compared: none of a design's own, which would speak for it."""
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
    """The shortest test that separates rivals, each simulated as it was fitted to a record.

    Parameters
    ----------
    record : Record
        Which does not separate the rivals.
    fits : mapping
        By effect id, or `NOTHING`.
    """
    largest_us = float(record.pulse_width_us.max())
    rows = [(design, design.pulse_widths(record.pulse_rate_hz)) for design in designs(largest_us)]
    expected = [expected_log_evidence(width, record, fits) for _, width in rows]
    enough = [place for place, gain in enumerate(expected) if gain >= ENOUGH]
    if enough:
        best = min(enough, key=lambda place: rows[place][1].size)
    else:
        best = max(range(len(rows)), key=lambda place: expected[place] / rows[place][1].size)
    (design, width), gain = rows[best], expected[best]
    names = tuple(name for name in fits if name != NOTHING)
    text = _text(design, width.size / record.pulse_rate_hz, gain, names)
    decides = gain >= ENOUGH
    return Experiment(names, *_played(design, width, record, next(iter(fits.values()))), gain, decides, text)


def _played(
    design: Design, width_us: np.ndarray, record: Record, fitted: Fitted
) -> tuple[Any, float, dict[str, float]]:
    """Segments, duration, s, and dose of a test."""
    torque_nm = fitted.physical[fitted.problem.coefficients] @ fitted.problem.setup.basis.design(width_us).T
    dose = {
        "pulses": int(np.sum(width_us > 0)),
        "pulse_width_sum_us": float(width_us.sum()),
        "torque_time_nm_s": float(np.abs(torque_nm).sum() / record.pulse_rate_hz),
    }
    return tuple(segment.to_dict() for segment in design.segments), width_us.size / record.pulse_rate_hz, dose


def plan_further(record: Record, fitted: Fitted) -> Experiment:
    """The test that teaches a model most, where structure is left and no two effects stand against one another.

    Held random levels, in the design after which the model's own standard error on other such levels is smallest: jumps
    of level while stimulated are what the paper's test lacks. A further ramp taught muscles of other physics nothing.

    Parameters
    ----------
    record : Record
        In which structure is left.
    fitted : Fitted
        The last model.
    """
    largest_us, rate_hz = float(record.pulse_width_us.max()), record.pulse_rate_hz
    # the smallest width with a tenth of the largest torque
    widths_us = np.linspace(0.0, fitted.problem.setup.basis.largest_us, 201)
    torque_nm = fitted.problem.setup.basis.design(widths_us) @ fitted.physical[fitted.problem.coefficients]
    threshold_us = float(widths_us[np.argmax(np.abs(torque_nm) >= 0.1 * np.abs(torque_nm).max())])
    rows = [(design, design.pulse_widths(rate_hz)) for design in held_levels(largest_us, threshold_us, rate_hz)]
    others = [design.pulse_widths(rate_hz) for design in held_levels(largest_us, threshold_us, rate_hz, REFERENCE)]
    reference = _simulate(fitted, _blank(record, np.concatenate(others)), True)[1]
    before = _expected_nm(fitted, reference, np.zeros((fitted.theta.size, 1)))
    after = [_expected_nm(fitted, reference, _whitened_slopes(fitted, _blank(record, width))) for _, width in rows]
    best = int(np.argmin(after))
    design, width = rows[best]
    fall, played = 1.0 - after[best] / before, _played(design, width, record, fitted)
    text = (
        f"{design.words} ({played[1]:.0f} s) would teach most about what is left: the model's own standard error on "
        f"levels is expected to fall by {100.0 * fall:.0f} %."
    )
    return Experiment((), *played, 0.0, False, text, fall)


def _whitened_slopes(fitted: Fitted, record: Record) -> np.ndarray:
    slopes = _simulate(fitted, record, True)[1]
    assert slopes is not None
    return whitened(slopes, ends_of([slice(0, slopes.shape[1])]), fitted.noise)


def _expected_nm(fitted: Fitted, reference: np.ndarray | None, white: np.ndarray) -> float:
    """Standard error of the model on a reference, N·m, once it has also seen a test of such whitened slopes."""
    assert reference is not None
    solution = np.linalg.lstsq(fitted.hessian + white @ white.T, reference, rcond=None)[0]
    return float(np.sqrt(max(np.mean(np.sum(reference * solution, axis=0)), 0.0)))


def _text(design: Design, duration_s: float, gain: float, names: tuple[str, ...]) -> str:
    those = " from ".join([*(find_effect(name).name.lower() for name in names[:2]), "no effect"][:2])
    test = f"{design.words} ({duration_s:.0f} s)"
    if gain >= ENOUGH:
        return f"{test} should separate {those}: expected log evidence {gain:.0f}."
    return (
        f"{test} is the best test to separate {those}, but it may not be enough: expected log evidence {gain:.1f}; "
        f"at least {ENOUGH:g} is required."
    )


def expected_log_evidence(width_us: np.ndarray, record: Record, fits: Mapping[str, Fitted]) -> float:
    """Log evidence by which a test of such widths separates that pair of rivals which it separates least.

    Parameters
    ----------
    width_us : ndarray
        Of the new test, µs, one for each pulse.
    record : Record
        Which does not separate the rivals.
    fits : mapping
        By effect id, or `NOTHING`.
    """
    simulated = _blank(record, width_us)
    return float(min(separation(fits[truth], fits[rival], simulated) for truth, rival in permutations(fits, 2)))


def _blank(record: Record, width: np.ndarray) -> Record:
    width_us, rate_hz = np.repeat(width, PER_PULSE), record.pulse_rate_hz
    time_s, zeros = np.arange(width_us.size) / (PER_PULSE * rate_hz), np.zeros(width_us.size)
    angle = None if record.angle_rad is None else zeros + float(record.angle_rad[0])
    still = None if record.velocity_rad_s is None else zeros
    return Record.from_arrays(time_s, width_us, zeros, angle_rad=angle, velocity_rad_s=still, pulse_rate_hz=rate_hz)


def separation(truth: Fitted, rival: Fitted, record: Record) -> float:
    """Log evidence by which a rival is expected to lose in a new test, if `truth` is true.

    The rival is fitted again to the new test, with its fit to the old record as prior.

    Parameters
    ----------
    truth : Fitted
        The fit that is taken for true.
    rival : Fitted
        The other one.
    record : Record
        The new test.
    """
    true_mean = _simulate(truth, record, False)[0]
    rival_mean, slopes = _simulate(rival, record, True)
    assert slopes is not None
    whole = ends_of([slice(0, true_mean.size)])
    white = whitened(np.vstack([true_mean - rival_mean, slopes]), whole, truth.noise)
    gap, slopes = white[0], white[1:]
    b = slopes @ gap
    gain = b @ np.linalg.lstsq(rival.hessian + slopes @ slopes.T, b, rcond=None)[0]
    return max(0.5 * float(gap @ gap - gain), 0.0)


def _simulate(fitted: Fitted, record: Record, derivatives: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Interval means of a fitted candidate on another record, without sporadic effects."""
    grid = make_grid(record)
    setup = fitted.problem.setup.with_(grid=grid, target_nm=np.zeros(grid.size), fitted=np.ones(grid.size, bool))
    lasting = [(effect, form) for effect, form in fitted.effects if not find_effect(effect).sporadic]
    problem = Problem(setup, lasting)
    # Parameters are copied by name: the new test has one part, starts at rest, and has no sporadic effects.
    known = {name: place for place, name in enumerate(fitted.problem.names)}
    place = np.array([known[name] for name in problem.names])
    theta = fitted.theta[place]
    theta[list(problem.initials)] = 0.0
    mean, slopes = problem.run(theta, derivatives=derivatives)
    if slopes is None:
        return mean, None
    full = np.zeros((fitted.theta.size, mean.size))
    full[place] = slopes
    return mean, full
