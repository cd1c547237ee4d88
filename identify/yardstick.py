"""Sentences on what repeats and what contradicts itself in a record, from the values in a fit alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

ALL = 99.95
"""Per cent that one decimal would round up to 100.0."""
TOO_LARGE = "Beside the torque that is too much to tell a share that the model explains."


def repetition_sentences(figures: Mapping[str, Any]) -> list[str]:
    """Describe the irreducible error and the share that the model explains; `figures`: fit statistics."""
    sentences, left_nm = _repeating(figures.get("repetition")), figures.get("unforeseen_nm")
    if left_nm:  # what a model explains in its own record and cannot predict
        causes = "hum, slow zero, tremor, efforts"
        sentences.append(f"On held-out pulses {left_nm:.3g} N·m cannot be foreseen ({causes}): it is left out.")
    return sentences


def _repeating(repetition: Mapping[str, Any] | None) -> list[str]:
    if not repetition:
        return []
    needed = ("rms_nm",) if repetition["found_by"] == "estimate" else ("found_by", "rms_nm", "repeats")
    if None in map(repetition.get, needed):
        return ["Too few repeats and rests to estimate the irreducible error."]
    share, between = _share(repetition["explained_percent"]), f"{repetition['rms_nm']:.3g}"
    if repetition["found_by"] == "estimate":
        at_rest = f"Nothing repeats exactly. At rest the mean torque of a pulse interval scatters by {between} N·m"
        if floor_nm(repetition) is None:
            return [f"{at_rest}; in such means the model's error is smaller."]
        lines = [f"{at_rest}: so much at least no model can foresee."]
        return [*lines, TOO_LARGE if share is None else f"The model explains {share} of all other variance."]
    lines = [f"Between {repetition['repeats']:.3g} repeats of the same pulses the torque differs by {between} N·m."]
    lines.append(TOO_LARGE if share is None else f"The model explains {share} of the variance that repeats.")
    errors = [repetition["held_out_rms_nm"], repetition["held_out_model_rms_nm"]]
    if None not in errors:
        plain, model = (f"{error:.3g}" for error in errors)
        lines.append(f"Held out, the mean of the other repeats errs by {plain} N·m, the model by {model} N·m.")
    return lines


def zero_words(zero_nm: float) -> str:
    """Say that the torque at rest is part of the error; it may be a zero, or force that no pulse explains."""
    return (
        f"At rest the model is off by {zero_nm:.2g} N·m, root mean square of the rests: a zero that wanders, or force "
        "that lingers. It is part of the error, and no effect of the model describes it."
    )


def contradiction_words(contradiction: Mapping[str, Any] | None) -> str:
    """Say which parts of the record contradict each other, and where; empty where none does significantly."""
    if not contradiction or not contradiction["significant"]:
        return ""
    pair = contradiction["pairs"][0]
    (first, second), (low, high) = pair["parts"], pair["pulse_width_us"]
    span = f"{low:.0f}-{high:.0f}" if high - low >= 1.0 else f"{high:.0f}"
    held = "" if pair["direction"] == "held" else f" {pair['direction']}"
    more = "more" if pair["largest_nm"] > 0.0 else "less"
    at = f"{span} µs{held}, {pair['start_s']:.1f}-{pair['end_s']:.1f} s"
    size, error = f"{abs(pair['largest_nm']):.2g} N·m {more}", f"{pair['largest_error_nm']:.1g} N·m"
    percent = f"{100.0 * contradiction['false_alarm_rate']:.0f} %"
    return (
        f"The parts of this record contradict each other at {at}: fitted to {first} alone the structure predicts "
        f"{size} there than fitted to {second} alone (standard error {error}). Noise alone says so in at most "
        f"{percent} of records, so the structure is not that of the muscle."
    )


def held_out_pulses(figures: Mapping[str, Any]) -> str:
    """The pulses whose errors these are, in a sentence."""
    return "parts left out in turn" if figures.get("held_out_by") == "cross-validation" else "held-out pulses"


def floor_nm(repetition: Mapping[str, Any]) -> float | None:
    """Irreducible error, N·m; None where the model errs by less, as it then explains the torque at rest."""
    scatter_nm, model_nm = repetition.get("rms_nm"), repetition.get("model_rms_nm") or math.inf
    if repetition.get("found_by") == "estimate" and scatter_nm and model_nm < scatter_nm:
        return None
    return scatter_nm


def _share(percent: float | None) -> str | None:
    """A share in words; what is rounded up to all is not all."""
    if percent is None:
        return None
    return f"{percent:.1f} %" if percent < ALL else "more than 99.9 %"


def repetition_words(figures: Mapping[str, Any]) -> str:
    """The same in one line; a dash where nothing is said."""
    return " ".join(repetition_sentences(figures)) or "–"
