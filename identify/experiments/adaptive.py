"""Adaptive test: after each piece, `decide` returns the next one, or ends the test.

`decide` has no state and no clock: it takes what was measured and played so far. A worker calls it after each piece;
when its answer is late, the rig plays the next piece of a fixed plan, and the worker is asked again with the longer
record.

`reach` predicts the result before the first pulse: it simulates the test on the last model of a known person, or on two
typical muscles for a new one, of which the worse counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.second_order import boundary_states
from stimrig.identify.errors import IdentifyError
from stimrig.identify.estimation.averaged import averaged
from stimrig.identify.estimation.disturbance import disturbed, unsure
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.residual_tests import residual_tests
from stimrig.identify.estimation.samples import Raw, prepare
from stimrig.identify.estimation.short_record import Short, fit_short
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.experiments.designs import Segment, pieces, played_widths
from stimrig.identify.experiments.knowledge import Knowledge, Target, foresee, knowledge, require_number
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment.near_shape import KNOTS

Kind = Literal["next", "enough", "misfit", "spent"]
REST_S, RISE_S, TOP_S, FALL_S = 0.5, 1.0, 0.3, 0.5
"""The opening: rest, a ramp to the largest width, a while there, silence."""
LEAST_S = 1.9
"""With a shorter record the opening is played."""
ALARM = 1e-3
"""P-value of a residual test below which the structure fits badly; each test is asked about ten times in one test."""
CONFIRMED_S = 1.0
"""A structure fits badly where it still does with a record that is longer by so much: by chance one test in a thousand
fails, and each is asked about again and again."""
EXCESS = 1.5
"""A residual larger than this many times the samples' noise is none of noise."""
ROUNDS = 3
"""Rounds of finding and removing a disturbance, each beside a better fit of the muscle."""
SETTLED_S = 4.0
"""No structure is judged before this, and so nothing is known well enough."""
SECOND_COST = 2.0
"""A second of a test costs as much as so many seconds of torque at the plateau. With a third of it, tests of the
paper's muscle took 14 s in place of 9 s for the same accuracy and dose (seeds 51000 and 51100)."""
LARGEST = 1e300
"""Numbers beyond it are none."""
SHARES = (0.03, 0.15, 0.35, 0.6, 0.85, 0.97)
"""Shares of the plateau whose widths are levels to move between."""


@dataclass(frozen=True)
class Decision:
    """The next segments to play, or the end of the test.

    Kinds are `next`: play `segments`. `enough`: both curves are known within the target. `misfit`: the structure fits
    badly; play the rest of the fixed test, so that the diagnosis gets its record. `spent`: no piece is left within the
    torque-time or the time.
    """

    kind: Kind
    segments: tuple[Segment, ...] = ()  # in order, as sequences of the rig; empty unless `kind` is `next`
    words: str = ""  # one sentence for people
    knowledge: Knowledge | None = None  # the bands as they are; None before the first fit
    expected_torque_time_nm_s: float = 0.0  # of the segments, by the mean curve
    short: Short | None = field(default=None, repr=False)  # the fit, which makes the next call faster (`before`)
    doubted_s: float | None = None  # length of the record with which the structure first fitted badly; None: it fits

    def to_dict(self) -> dict:
        """Plain values, for the test's document and the page."""
        return {
            "kind": self.kind,
            "segments": [segment.to_dict() for segment in self.segments],
            "words": self.words,
            "knowledge": None if self.knowledge is None else self.knowledge.to_dict(),
            "expected_torque_time_nm_s": self.expected_torque_time_nm_s,
        }


@dataclass(frozen=True)
class AdaptiveGoal:
    """Target and limits of a test, and earlier knowledge of the person.

    Raises BadRequest: a number that is none.
    """

    target: Target  # what must be known
    left_s: float  # time that the participant's profile still allows
    left_nm_s: float  # torque-time, N·m·s, that it still allows
    largest_us: float  # largest width that may be played
    pulse_rate_hz: float = 40.0
    earlier: Earlier | None = None  # what is known of this person from earlier sessions

    def __post_init__(self) -> None:
        for name in ("left_s", "left_nm_s", "largest_us", "pulse_rate_hz"):
            require_number(getattr(self, name), name, "no positive number", "Give a number from 0.", 0.0, LARGEST)


def decide(
    record: Record | None, played_us: np.ndarray | Sequence[float], goal: AdaptiveGoal, before: Decision | None = None
) -> Decision:
    """The next piece of an adaptive test, or its end.

    `record`: what was measured so far, from the test's first pulse; None before the first. `played_us`: widths of all
    pulses that were played or are committed, which may reach beyond the record's end. `goal`: the target, with
    what is left of the limits. `before`: the decision before this one; the search then starts from its fit.

    Raises BadRecord: the record holds what no measurement gives.
    """
    if record is None or record.time_s[-1] - record.time_s[0] < LEAST_S:
        return _opening(goal)
    try:
        grid, raw = prepare(record)
        with np.errstate(all="ignore"):
            short, wrong = _fitted(grid, raw, goal.earlier, before.short if before else None)
    except (np.linalg.LinAlgError, IdentifyError) as error:
        return Decision("misfit", words=f"No model can be fitted ({error}). The rest of the fixed test is played.")
    known, played = knowledge(short), np.asarray(played_us, float)
    if wrong:
        long_s = short.grid.size * short.grid.step_s
        since_s = long_s if before is None or before.doubted_s is None else before.doubted_s
        if long_s - since_s >= CONFIRMED_S or not _finite(short):
            words = f"{wrong} The rest of the fixed test is played."
            return Decision("misfit", words=words, knowledge=known, short=short)
        return replace(_next(short, known, played, goal), doubted_s=since_s)
    if known.reaches(goal.target) and _settled(short):
        return Decision("enough", words=f"Enough is known. {_state(known)}", knowledge=known, short=short)
    return _next(short, known, played, goal)


def _opening(goal: AdaptiveGoal) -> Decision:
    rate = goal.pulse_rate_hz
    before, up, top, after = (round(seconds * rate) for seconds in (REST_S, RISE_S, TOP_S, FALL_S))
    rise = goal.largest_us * np.arange(1, up + 1) / up
    widths = np.r_[np.zeros(before), rise, np.full(top, goal.largest_us), np.zeros(after)]
    earlier = goal.earlier
    dose = 0.0 if earlier is None else float(np.sum(np.abs(earlier.model.recruitment(widths))) / rate)
    if widths.size / rate > goal.left_s or dose > goal.left_nm_s:
        return Decision("spent", words="The torque-time or the time that is left does not allow a first piece.")
    return Decision("next", (played_widths("opening", widths),), "A first look at the whole range.", None, dose)


def _fitted(grid: Grid, raw: Raw, last: Earlier | None, before: Short | None) -> tuple[Short, str | None]:
    """The fit, and why it does not describe the record; with more knots where the usual number leaves a residual, then
    without what no pulse causes."""
    fine = before is not None and before.basis.knots_us.size > KNOTS
    short = fit_short(grid, grid.fitted, last=last, before=before, fine=fine)
    wrong = _misfit(short)
    if wrong and not fine:
        short = fit_short(grid, grid.fitted, last=last, before=short, fine=True)
        wrong = _misfit(short)
    mains_hz = None if raw.hum is None else raw.hum["frequency_hz"]
    for _ in range(ROUNDS if wrong and _finite(short) else 0):
        disturbed_fit, added_nm = disturbed(short, short.grid.mean_noise_nm(short.rows), mains_hz)
        grid = replace(grid, torque_nm=grid.torque_nm - added_nm)
        short = fit_short(grid, grid.fitted, last=last, before=short, fine=True)
        if _unexplained(disturbed_fit, short.grid.mean_noise_nm(short.rows)) is None:
            return unsure(short, disturbed_fit), None
    return short, wrong


def _finite(short: Short) -> bool:
    return bool(np.all(np.isfinite(short.coefficients_nm)) and np.all(np.isfinite(short.dynamics)))


def _misfit(short: Short) -> str | None:
    """Why the structure does not describe the record; None if it does, or if it is too early to say."""
    if not _finite(short):
        return "The estimate is not finite."
    if not _settled(short):
        return None
    return _unexplained(averaged(short, mean_of_draws=False), short.grid.mean_noise_nm(short.rows))


def _unexplained(fitted: Fitted, white_nm: float) -> str | None:
    """Why what a fit leaves is more than noise; None if it is not."""
    residual_nm, noise_nm = fitted.rms_nm, white_nm
    if residual_nm > EXCESS * noise_nm:
        return f"The structure leaves {residual_nm:.2g} N·m where the noise is {noise_nm:.2g} N·m."
    failed = [name for name, test in residual_tests(fitted).items() if test["p_value"] < ALARM]
    return f"The residual is not noise ({' and '.join(failed)})." if failed else None


def _settled(short: Short) -> bool:
    return short.grid.size * short.grid.step_s >= SETTLED_S


def _next(short: Short, known: Knowledge, played: np.ndarray, goal: AdaptiveGoal) -> Decision:
    candidates = pieces(_levels(short, known, goal.largest_us), 1.0 / short.grid.step_s)
    now, after, dose = foresee(short, played, goal.target, candidates)
    seconds = np.array([len(piece.settings["pulse_width_us"]) for piece in candidates]) * short.grid.step_s
    allowed = (dose <= goal.left_nm_s) & (seconds <= goal.left_s + 1e-9)
    if not allowed.any():
        words = f"The torque-time or the time is used up. {_state(known)}"
        return Decision("spent", words=words, knowledge=known, short=short)
    cost = dose / max(known.plateau_nm, 1e-9) + SECOND_COST * seconds
    score = np.where(allowed, np.log(np.maximum(now / after, 1.0)) / cost, -1.0)
    best = int(np.argmax(score))
    return Decision("next", (candidates[best],), _state(known), known, float(max(dose[best], 0.0)), short)


def _levels(short: Short, known: Knowledge, largest_us: float) -> np.ndarray:
    """Widths to move between: at shares of the plateau, where the curve is known least, and both ends."""
    u = np.linspace(0.0, min(largest_us, short.basis.largest_us), 301)
    rising = np.maximum.accumulate(short.basis.design(u) @ short.mean_nm) / max(short.plateau_nm, 1e-9)
    at = [float(np.interp(share, rising + 1e-9 * np.arange(u.size), u)) for share in SHARES]
    half = known.curve.half.copy()
    for _ in range(3):
        worst = int(np.argmax(half))
        at.append(float(min(known.curve.at[worst], largest_us)))
        half[max(worst - 4, 0) : worst + 5] = 0.0
    return np.array([0.0, *at, largest_us])


def _state(known: Knowledge) -> str:
    curve, step = f"{known.curve.percent:.1f} %", f"{known.step.percent:.1f} %"
    return f"The curve is known within {curve}, the step response within {step}."


# ---- what a test can reach ----

SAMPLES = 10
"""Simulated samples per pulse."""
NOISE_NM = 0.05
"""White noise of a simulated sample."""
USUAL = (SecondOrder(0.35, 0.9), ((1.0, 0.40, 0.05),)), (SecondOrder(0.45, 0.8), ((0.5, 0.30, 0.03), (0.5, 0.60, 0.04)))
"""Two muscles: dynamics, and groups of motor units: share, middle and width of their thresholds in largest widths."""


@dataclass(frozen=True)
class Reach:
    """Predicted result of an adaptive test."""

    reachable: bool  # whether the target is
    curve_percent: float  # largest half-width of this band at the end, %
    step_percent: float
    seconds: float  # that the test then took
    torque_time_nm_s: float
    words: str  # one sentence for people


def reach(goal: AdaptiveGoal, plateau_nm: float) -> Reach:
    """Predict the result of an adaptive test by simulation.

    `plateau_nm`: torque at the largest width, N·m, from the calibration, or a guess. A known person's last model is
    used instead. Of two usual muscles that counts which misses the target by more, or takes more torque-time.

    Raises BadRequest: a number that is none.
    """
    require_number(plateau_nm, "plateau_nm", "no positive number", "Give a number above 0, in N·m.", 1e-300, LARGEST)
    earlier = goal.earlier
    if earlier is not None:
        return _play(earlier.linear, lambda u: np.abs(earlier.model.recruitment(u)), goal)

    def curve(width_us: np.ndarray, groups: Sequence[tuple[float, float, float]]) -> np.ndarray:
        share, middle, width = np.array(groups).T[:, :, None]
        recruited = np.tanh(0.5 * (np.r_[0.0, width_us] / goal.largest_us - middle) / width)
        return 0.5 * plateau_nm * (share * (recruited[:, 1:] - recruited[:, :1])).sum(axis=0)

    tests = [_play(linear, partial(curve, groups=groups), goal) for linear, groups in USUAL]
    if all(test.reachable for test in tests):
        return max(tests, key=lambda test: (test.torque_time_nm_s, test.seconds))
    return max(tests, key=lambda test: (not test.reachable, max(test.curve_percent, test.step_percent)))


def _play(linear: SecondOrder, curve: Callable[[np.ndarray], np.ndarray], goal: AdaptiveGoal) -> Reach:
    rate = goal.pulse_rate_hz
    widths, record, decision, dose = np.zeros(0), None, None, 0.0
    while True:
        left_s, left_nm_s = max(goal.left_s - widths.size / rate, 0.0), max(goal.left_nm_s - dose, 0.0)
        decision = decide(record, widths, replace(goal, left_s=left_s, left_nm_s=left_nm_s), decision)
        if decision.kind != "next":
            break
        widths = np.r_[widths, *(segment.settings["pulse_width_us"] for segment in decision.segments)]
        dose = float(np.sum(curve(widths))) / rate
        if record is None and dose > goal.left_nm_s:
            decision = Decision("spent")
            break
        drive = np.repeat(curve(widths), SAMPLES)
        torque = boundary_states(linear.core, 1.0 / (rate * SAMPLES), drive[None, :])[0][0, :-1]
        # Always the same noise: the same question has one answer, and what was measured stays.
        measured = torque + NOISE_NM * np.random.default_rng(1).standard_normal(torque.size)
        time_s = np.arange(torque.size) / (rate * SAMPLES)
        record = Record.from_arrays(time_s, np.repeat(widths, SAMPLES), measured, pulse_rate_hz=rate)
    if decision.knowledge is None:
        words = "The torque-time or the time that is left does not allow a first piece: nothing can be reached."
        return Reach(False, float("inf"), float("inf"), 0.0, 0.0, words)
    seconds, known, there = widths.size / rate, decision.knowledge, decision.knowledge.reaches(goal.target)
    words = f"The target should be reached in about {seconds:.0f} s with {dose:.0f} N·m·s."
    if not there:
        words = (
            f"The target is probably out of reach: in {seconds:.0f} s and with {dose:.0f} N·m·s the curve would be "
            f"known within {known.curve.percent:.1f} % and the step response within {known.step.percent:.1f} %."
        )
    return Reach(there, known.curve.percent, known.step.percent, seconds, dose, words)
