"""What an adaptive test can reach within a torque-time and a time: said before the first pulse.

The test is played in a simulation: on the last model of a known person, or on two usual muscles for a new one. The
worse of the two counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.states import boundary_states
from stimrig.identify.errors import BadRequest
from stimrig.identify.estimation.earlier import Change, Earlier
from stimrig.identify.experiments.adaptive import Decision, decide
from stimrig.identify.experiments.knowledge import Target
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record

SAMPLES = 10
"""Simulated samples per pulse."""
USUAL = (SecondOrder(0.35, 0.9), ((1.0, 0.40, 0.05),)), (SecondOrder(0.45, 0.8), ((0.5, 0.30, 0.03), (0.5, 0.60, 0.04)))
"""Two muscles: dynamics, and groups of motor units: share, middle and width of their thresholds in largest widths."""


@dataclass(frozen=True)
class Reach:
    """What a test will probably reach.

    Parameters
    ----------
    reachable : bool
        Whether the target is.
    curve_percent, step_percent : float
        Largest half-widths of both bands at the end, %.
    seconds, torque_time_nm_s : float
        What the test then took.
    words : str
        One sentence for people.
    """

    reachable: bool
    curve_percent: float
    step_percent: float
    seconds: float
    torque_time_nm_s: float
    words: str

    @property
    def cost(self) -> tuple[float, float]:
        """What is worse the larger it is: torque-time and time, or the bands that are left, %."""
        if self.reachable:
            return self.torque_time_nm_s, self.seconds
        return max(self.curve_percent, self.step_percent), self.torque_time_nm_s


def reach(
    *,
    target: Target,
    left_s: float,
    left_nm_s: float,
    largest_us: float,
    plateau_nm: float,
    noise_nm: float = 0.05,
    pulse_rate_hz: float = 40.0,
    earlier: Model | None = None,
    change: Change | None = None,
) -> Reach:
    """What an adaptive test can reach.

    Parameters
    ----------
    target : Target
        What must be known.
    left_s, left_nm_s : float
        Time, s, and torque-time, N·m·s, that the profile allows.
    largest_us : float
        Largest width that may be played, µs.
    plateau_nm : float
        Torque at that width, N·m: from the calibration, or a guess. A known person's last model is used instead.
    noise_nm : float
        White noise of a sample of the load cell at ten samples per pulse, N·m.
    pulse_rate_hz : float
        Pulses a second.
    earlier, change : Model, Change, optional
        As for `decide`.

    Raises
    ------
    BadRequest
        A number that is none.
    """
    for name, value in (("plateau_nm", plateau_nm), ("noise_nm", noise_nm)):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < float("inf"):
            raise BadRequest(f"{value!r} is no positive number", place=name, fix="Give a number above 0, in N·m.")
    limits = {"left_s": left_s, "left_nm_s": left_nm_s, "largest_us": largest_us, "pulse_rate_hz": pulse_rate_hz}
    if earlier is not None:
        last = Earlier(earlier, change or Change())
        muscles = [(last.linear, lambda u: np.abs(earlier.recruitment(u)))]
    else:
        muscles = [(linear, _curve(groups, largest_us, plateau_nm)) for linear, groups in USUAL]
    known = {"earlier": earlier, "change": change} if earlier is not None else {}
    tests = [_play(linear, curve, target, noise_nm, limits, known) for linear, curve in muscles]
    return worse(tests)


def worse(tests: Sequence[Reach]) -> Reach:
    """That which misses the target by more; if all reach it, that which takes more."""
    return max(tests, key=lambda test: (not test.reachable, *test.cost))


Curve = Callable[[np.ndarray], np.ndarray]
Groups = tuple[tuple[float, float, float], ...]


def _curve(groups: Groups, largest_us: float, plateau_nm: float) -> Curve:
    def curve(width_us: np.ndarray) -> np.ndarray:
        x = np.asarray(width_us, float) / largest_us
        total = sum(share * (np.tanh(0.5 * (x - middle) / width) + 1.0) / 2.0 for share, middle, width in groups)
        start = sum(share * (np.tanh(-0.5 * middle / width) + 1.0) / 2.0 for share, middle, width in groups)
        return np.asarray(plateau_nm * (total - start))

    return curve


def _play(linear: SecondOrder, curve: Curve, target: Target, noise_nm: float, limits: dict, known: dict) -> Reach:
    rate = limits["pulse_rate_hz"]
    widths, record, decision, dose = np.zeros(0), None, None, 0.0
    while True:
        left = limits | {
            "left_s": max(limits["left_s"] - widths.size / rate, 0.0),
            "left_nm_s": max(limits["left_nm_s"] - dose, 0.0),
        }
        decision = decide(record, widths, target=target, before=decision, **left, **known)
        if decision.kind != "next":
            return _reached(decision, target, widths.size / rate, dose)
        widths = np.r_[widths, *(segment.settings["pulse_width_us"] for segment in decision.segments)]
        dose = float(np.sum(curve(widths))) / rate
        if record is None and dose > limits["left_nm_s"]:
            return _reached(Decision("spent"), target, 0.0, 0.0)
        drive = np.repeat(curve(widths), SAMPLES)
        torque = boundary_states(*linear.core, 1.0 / (rate * SAMPLES), drive)[0][:-1]
        # Always the same noise: the same question has one answer, and what was measured stays.
        measured = torque + noise_nm * np.random.default_rng(1).standard_normal(torque.size)
        time_s = np.arange(torque.size) / (rate * SAMPLES)
        record = Record.from_arrays(time_s, np.repeat(widths, SAMPLES), measured, pulse_rate_hz=rate)


def _reached(decision: Decision, target: Target, seconds: float, torque_time_nm_s: float) -> Reach:
    if decision.knowledge is None:
        words = "The torque-time or the time that is left does not allow a first piece: nothing can be reached."
        return Reach(False, float("inf"), float("inf"), 0.0, 0.0, words)
    curve, step = decision.knowledge.curve.percent, decision.knowledge.step.percent
    there = curve <= target.curve_percent and step <= target.step_percent
    words = f"The target should be reached in about {seconds:.0f} s with {torque_time_nm_s:.0f} N·m·s."
    if not there:
        words = (
            f"The target is probably out of reach: in {seconds:.0f} s and with {torque_time_nm_s:.0f} N·m·s the curve "
            f"would be known within {curve:.1f} % and the step response within {step:.1f} %."
        )
    return Reach(there, curve, step, seconds, torque_time_nm_s, words)
