"""A test of several muscles that stops itself: after each piece the next one, or the word that enough is known.

`decide` has no state and no clock, as that of one muscle (`identify.experiments.adaptive`). The dose of each channel is
bounded for the whole test: a piece that could lead beyond what a channel may still get is not played.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from stimrig.identify.errors import BadRequest, IdentifyError
from stimrig.identify.experiments.knowledge import Knowledge, Target
from stimrig.identify.muscles.foresight import Foresight
from stimrig.identify.muscles.joint_fit import JointFitted, fit_all
from stimrig.identify.muscles.pieces import Piece, Pieces
from stimrig.identify.muscles.problem import Acting
from stimrig.identify.muscles.record import JointRecord
from stimrig.identify.muscles.search import MARGIN

SECOND_COST = 1.0
"""A second of a test costs as much as so many seconds of one muscle's torque at its plateau."""
SHARES = (0.1, 0.35, 0.65, 0.9)
"""Shares of the plateau whose widths are levels to move between."""
WIDEST = 2
"""Further levels, where the curve is known least."""
SETTLED_S = 12.0
"""Nothing is known well enough before this: in less, neither fatigue nor what the muscles do to each other shows."""
AROUND = 6
"""Places of a band on either side of one that is a level already."""


@dataclass(frozen=True)
class Asked:
    """What a test is to find out, and what all of it may cost; one value for each channel.

    Raises BadRequest: a number that is none, or not one for each channel.
    """

    names: tuple[str, ...]  # of the channels
    target: Target  # what must be known of each muscle
    most_s: float  # time
    most_nm_s: tuple[float, ...]  # torque-time of each channel, N·m·s
    most_us: tuple[float, ...]  # largest sum of the widths of each channel, its charge over its current
    largest_us: tuple[float, ...]  # largest width that may be played
    largest_nm: tuple[float, ...]  # its torque at that width at most, as the calibration shows it
    pulse_rate_hz: float = 40.0

    def __post_init__(self) -> None:
        for name in ("most_nm_s", "most_us", "largest_us", "largest_nm"):
            if len(getattr(self, name)) != len(self.names):
                raise BadRequest("not one number for each channel", place=name, fix="Give one for each channel.")
        numbers = [(name, (getattr(self, name),)) for name in ("most_s", "pulse_rate_hz")]
        numbers += [(name, getattr(self, name)) for name in ("most_nm_s", "most_us", "largest_us", "largest_nm")]
        for name, values in numbers:
            for value in values:
                if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < float("inf"):
                    raise BadRequest(f"{value!r} is no positive number", place=name, fix="Give a number above 0.")


@dataclass(frozen=True)
class Decision:
    """What to play next, or that the test ends.

    Kinds are `next`: play `piece`. `enough`: all curves are known within the target. `misfit`: no model can be fitted;
    play the rest of the fixed test. `spent`: no piece is left within the time and the doses.
    """

    kind: Literal["next", "enough", "misfit", "spent"]
    piece: Piece | None = None  # None unless `kind` is `next`
    words: str = ""  # one sentence for people
    knowledge: tuple[Knowledge, ...] = ()  # of each channel; none before the first fit
    dose_nm_s: tuple[float, ...] = field(default=())
    """Torque-time of each channel at the end of what is laid, with `piece`, at most."""


def decide(record: JointRecord | None, played_us: np.ndarray, asked: Asked) -> Decision:
    """The next piece of an adaptive test of several muscles, or its end.

    Parameters
    ----------
    record : JointRecord or None
        What was measured so far, from the test's first pulse; None before the first piece has been played.
    played_us : array, shape (P, C)
        Widths of all pulses of each channel that were played or are committed, µs; may reach beyond the record's end.
    asked : Asked
        What the test is to find out, and what it may cost. Its channels and its pulse rate must be the record's.

    A record that cannot be used is a `misfit`, with the reason in its words. What then plays is the caller's choice.
    """
    if record is None:
        return _opening(asked)
    try:
        with np.errstate(all="ignore"):
            return _judged(Foresight(fitted(record)), np.asarray(played_us, float), asked)
    except (np.linalg.LinAlgError, IdentifyError) as error:
        return Decision("misfit", words=f"No model can be fitted ({error}). The rest of the fixed test is played.")


def fitted(record: JointRecord) -> JointFitted:
    """The muscles, with co-contraction if the evidence asks for it.

    Cross-talk is not looked for: of a short record it cannot be told from a weaker muscle, and no band would narrow.
    """
    plain = fit_all(record)
    tried = plain.with_likeliest(Acting.meant("co_contraction", record.names))
    return tried if tried.fitted.log_evidence - plain.fitted.log_evidence >= MARGIN else plain


def _judged(foresight: Foresight, played_us: np.ndarray, asked: Asked) -> Decision:
    known = foresight.knowledge
    settled = len(played_us) / asked.pulse_rate_hz >= SETTLED_S
    if settled and all(one.reaches(asked.target) for one in known):
        dose = tuple(foresight.doses([Piece("played", played_us)])[0].tolist())
        return Decision("enough", None, f"Enough is known. {_state(asked.names, known)}", known, dose)
    return _next(foresight, played_us, asked)


def _opening(asked: Asked) -> Decision:
    """Nothing is known: each pulse counts as the largest torque."""
    levels = [np.array([0.35, 0.5, 0.65, 0.8, 1.0]) * top_us for top_us in asked.largest_us]
    piece = Pieces(levels, asked.pulse_rate_hz, 0).opening()
    widths_us = piece.pulse_width_us
    dose = np.array(asked.largest_nm) * np.sum(widths_us > 0.0, axis=0) / asked.pulse_rate_hz
    if not _allowed(widths_us, dose, asked):
        return Decision("spent", words="The time or the dose of a channel does not allow a first piece.")
    return Decision("next", piece, "A first look at each muscle, and at all.", (), tuple(dose.tolist()))


def _allowed(widths_us: np.ndarray, dose_nm_s: np.ndarray, asked: Asked) -> bool:
    """Whether a whole test of these widths keeps to the time and to the doses of each channel."""
    return bool(
        len(widths_us) / asked.pulse_rate_hz <= asked.most_s + 1e-9
        and np.all(dose_nm_s <= asked.most_nm_s)
        and np.all(widths_us.sum(axis=0) <= asked.most_us)
    )


def _next(foresight: Foresight, played: np.ndarray, asked: Asked) -> Decision:
    known = foresight.knowledge
    levels = [_levels(one, top_us) for one, top_us in zip(known, asked.largest_us, strict=True)]
    pieces = Pieces(levels, asked.pulse_rate_hz, len(played)).candidates()
    spent, *doses = foresight.doses([Piece("played", played), *pieces])
    allowed = [
        _allowed(np.concatenate([played, piece.pulse_width_us]), spent + dose, asked)
        for piece, dose in zip(pieces, doses, strict=True)
    ]
    if not any(allowed):
        words = f"The time or the dose of a channel is used up. {_state(asked.names, known)}"
        return Decision("spent", None, words, known, tuple(spent.tolist()))
    now, after = foresight.after(pieces, asked.target)
    plateaus = np.array([one.plateau_nm for one in known])
    seconds = np.array([len(piece.pulse_width_us) for piece in pieces]) / asked.pulse_rate_hz
    cost = np.sum(np.array(doses) / plateaus, axis=1) + SECOND_COST * seconds
    best = int(np.argmax(np.where(allowed, np.log(now / after) / cost, -np.inf)))
    total = tuple((spent + doses[best]).tolist())
    return Decision("next", pieces[best], _state(asked.names, known), known, total)


def _levels(known: Knowledge, largest_us: float) -> np.ndarray:
    """Widths to move between: at shares of the plateau, where the curve is known least, and the largest."""
    curve = known.curve
    rising = np.maximum.accumulate(curve.value) + 1e-9 * np.arange(curve.value.size)
    at = [float(np.interp(share, rising, curve.at)) for share in SHARES]
    half = np.where(curve.at > 0.0, curve.half, 0.0)
    for _ in range(WIDEST):
        worst = int(np.argmax(half))
        at.append(float(curve.at[worst]))
        half[max(worst - AROUND, 0) : worst + AROUND + 1] = 0.0
    return np.unique(np.minimum([*at, largest_us], largest_us))


def _state(names: Sequence[str], known: Sequence[Knowledge]) -> str:
    told = [
        f"{name}: the curve within {one.curve.percent:.1f} %, the step response within {one.step.percent:.1f} %"
        for name, one in zip(names, known, strict=True)
    ]
    return f"{'; '.join(told)}."
