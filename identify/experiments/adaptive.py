"""A test that stops itself: after each piece, the next one, or the word that enough is known.

`decide` has no state and no clock: it takes what was measured and played so far. A worker calls it after each piece;
when its answer is late, the rig plays the next piece of a fixed plan, and the worker is asked again with the longer
record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.errors import BadRequest, IdentifyError
from stimrig.identify.estimation.averaged import averaged
from stimrig.identify.estimation.earlier import Change, Earlier
from stimrig.identify.estimation.plain import prepare
from stimrig.identify.estimation.residual_tests import residual_tests
from stimrig.identify.estimation.short_record import Short, fit_short
from stimrig.identify.experiments.designs import Piece, Segment, pieces
from stimrig.identify.experiments.knowledge import Foresight, Knowledge, Target, knowledge
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.recruitment.near_shape import KNOTS

Kind = Literal["next", "enough", "misfit", "spent"]
REST_S, RISE_S, TOP_S, FALL_S = 0.5, 1.0, 0.3, 0.5
"""The opening: rest, a ramp to the largest width, a while there, silence."""
LEAST_S = 2.0
"""A record that is shorter tells nothing: the opening is played."""
ALARM = 1e-3
"""P-value of a residual test below which the structure fits badly; each test is asked about ten times in one test."""
EXCESS = 1.5
"""A residual larger than this many times the samples' noise is none of noise."""
SETTLED_S = 4.0
"""No structure is judged before this, and so nothing is known well enough."""
SECOND_COST = 2.0
"""A second of a test costs as much as so many seconds of torque at the plateau. With a third of it, tests of the
paper's muscle took 14 s in place of 9 s for the same accuracy and dose (seeds 51000 and 51100)."""
SHARES = (0.03, 0.15, 0.35, 0.6, 0.85, 0.97)
"""Shares of the plateau whose widths are levels to move between."""


@dataclass(frozen=True)
class Decision:
    """What to play next, or that the test ends.

    Parameters
    ----------
    kind : str
        `next`: play `segments`. `enough`: both curves are known within the target. `misfit`: the structure fits badly;
        play the rest of the fixed test, so that the diagnosis gets its record. `spent`: no piece is left within the
        torque-time or the time.
    segments : tuple of Segment
        What to play, in order, as sequences of the rig; empty unless `kind` is `next`.
    words : str
        One sentence for people.
    knowledge : Knowledge or None
        The bands as they are; None before the first fit.
    expected_torque_time_nm_s : float
        Torque-time of the segments, N·m·s, by the mean curve.
    short : Short or None
        The fit, which makes the next call faster (`before`).
    """

    kind: Kind
    segments: tuple[Segment, ...] = ()
    words: str = ""
    knowledge: Knowledge | None = None
    expected_torque_time_nm_s: float = 0.0
    short: Short | None = field(default=None, repr=False)

    def to_dict(self) -> dict:
        """Plain values, for the test's document and the page."""
        return {
            "kind": self.kind,
            "segments": [segment.to_dict() for segment in self.segments],
            "words": self.words,
            "knowledge": None if self.knowledge is None else self.knowledge.to_dict(),
            "expected_torque_time_nm_s": self.expected_torque_time_nm_s,
        }


def decide(
    record: Record | None,
    played_us: np.ndarray | Sequence[float],
    *,
    target: Target,
    left_s: float,
    left_nm_s: float,
    largest_us: float,
    pulse_rate_hz: float = 40.0,
    earlier: Model | None = None,
    change: Change | None = None,
    before: Decision | None = None,
) -> Decision:
    """The next piece of an adaptive test, or its end.

    Parameters
    ----------
    record : Record or None
        What was measured so far, from the test's first pulse; None before the first.
    played_us : array, shape (P,)
        Widths of all pulses that were played or are committed, µs; may reach beyond the record's end.
    target : Target
        What must be known.
    left_s, left_nm_s : float
        Time, s, and torque-time, N·m·s, that the participant's profile still allows.
    largest_us : float
        Largest width that may be played, µs.
    pulse_rate_hz : float
        Pulses a second.
    earlier : Model, optional
        The last approved model of this person, with second-order dynamics.
    change : Change, optional
        By how much this person changes between sessions (`learn_change`); the usual change if None.
    before : Decision, optional
        The decision before this one: the search then starts from its fit.

    Returns
    -------
    Decision

    Raises
    ------
    BadRequest
        A number that is none, or an earlier model that cannot be used.
    BadRecord
        The record holds what no measurement gives.
    """
    _check(left_s=left_s, left_nm_s=left_nm_s, largest_us=largest_us, pulse_rate_hz=pulse_rate_hz)
    played = np.asarray(played_us, float)
    last = None if earlier is None else Earlier(earlier, change or Change())
    if record is None or record.time_s[-1] - record.time_s[0] < LEAST_S:
        return _opening(largest_us, pulse_rate_hz, left_s, left_nm_s, last)
    try:
        grid, _ = prepare(record)
        with np.errstate(all="ignore"):
            short, wrong = _fitted(grid, last, before.short if before else None)
    except (np.linalg.LinAlgError, IdentifyError) as error:
        return Decision("misfit", words=f"No model can be fitted ({error}). The rest of the fixed test is played.")
    known = knowledge(short)
    if wrong:
        return Decision("misfit", words=f"{wrong} The rest of the fixed test is played.", knowledge=known, short=short)
    there = known.curve.percent <= target.curve_percent and known.step.percent <= target.step_percent
    if there and _settled(short):
        return Decision("enough", words=f"Enough is known. {_state(known)}", knowledge=known, short=short)
    return _next(short, known, played, target, left_s, left_nm_s, largest_us)


def _check(**numbers: float) -> None:
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < float("inf"):
            raise BadRequest(f"{value!r} is no positive number", place=name, fix="Give a number from 0.")


def _opening(largest_us: float, rate: float, left_s: float, left_nm_s: float, last: Earlier | None) -> Decision:
    rise = largest_us * np.arange(1, round(RISE_S * rate) + 1) / round(RISE_S * rate)
    widths = np.r_[
        np.zeros(round(REST_S * rate)), rise, np.full(round(TOP_S * rate), largest_us), np.zeros(round(FALL_S * rate))
    ]
    dose = 0.0 if last is None else float(np.sum(np.abs(last.model.recruitment(widths))) / rate)
    if widths.size / rate > left_s or dose > left_nm_s:
        return Decision("spent", words="The torque-time or the time that is left does not allow a first piece.")
    return Decision("next", (Piece("opening", widths).segment(1),), "A first look at the whole range.", None, dose)


def _fitted(grid: Grid, last: Earlier | None, before: Short | None) -> tuple[Short, str | None]:
    """The fit, and why it does not describe the record; with more knots where the usual number leaves a residual."""
    fine = before is not None and before.basis.knots_us.size > KNOTS
    short = fit_short(grid, grid.fitted, last=last, before=before, fine=fine)
    wrong = _misfit(short)
    if wrong and not fine:
        short = fit_short(grid, grid.fitted, last=last, before=short, fine=True)
        wrong = _misfit(short)
    return short, wrong


def _misfit(short: Short) -> str | None:
    """Why the structure does not describe the record; None if it does, or if it is too early to say."""
    if not np.all(np.isfinite(short.coefficients_nm)) or not np.all(np.isfinite(short.dynamics)):
        return "The estimate is not finite."
    if not _settled(short):
        return None
    white = short.grid.noise_sd_nm / np.sqrt(max(float(np.median(short.grid.count[short.rows])), 1.0))
    own = float(np.sqrt(np.mean(short.residual_nm[short.rows] ** 2)))
    if own > EXCESS * white:
        return f"The structure leaves {own:.2g} N·m where the noise is {white:.2g} N·m."
    tests = residual_tests(averaged(short, mean_of_draws=False))
    failed = [name for name, test in tests.items() if test["p_value"] < ALARM]
    return f"The residual is not noise ({' and '.join(failed)})." if failed else None


def _settled(short: Short) -> bool:
    """Whether the record is long enough to judge the structure by."""
    return short.grid.size * short.grid.step_s >= SETTLED_S


def _next(
    short: Short,
    known: Knowledge,
    played: np.ndarray,
    target: Target,
    left_s: float,
    left_nm_s: float,
    largest_us: float,
) -> Decision:
    rate = 1.0 / short.grid.step_s
    foresight = Foresight.of(short, played, target)
    candidates = pieces(_levels(short, known, largest_us), rate)
    after, dose = foresight.after(candidates)
    seconds = np.array([piece.pulse_width_us.size for piece in candidates]) / rate
    allowed = (dose <= left_nm_s) & (seconds <= left_s + 1e-9)
    if not allowed.any():
        return Decision(
            "spent", words=f"The torque-time or the time is used up. {_state(known)}", knowledge=known, short=short
        )
    cost = dose / max(known.plateau_nm, 1e-9) + SECOND_COST * seconds
    score = np.where(allowed, np.log(np.maximum(foresight.now / after, 1.0)) / cost, -1.0)
    best = int(np.argmax(score))
    number = sum(1 for _ in short.grid.record.segment_names) + 1
    return Decision(
        "next", (candidates[best].segment(number),), _state(known), known, float(max(dose[best], 0.0)), short
    )


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
    return (
        f"The curve is known within {known.curve.percent:.1f} %, the step response within {known.step.percent:.1f} %."
    )
