"""Sentences on what repeats in a record, from the values of `repetition` in a fit alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

ALL = 99.95
"""Per cent that one decimal would round up to 100.0."""
TOO_LARGE = "Beside the torque that is too much to tell a share that the model explains."


def repetition_sentences(figures: Mapping[str, Any]) -> list[str]:
    """What repetition says cannot be better, and how much of what repeats the model explains; `figures`: fit
    statistics.
    """
    return [*_repeating(figures.get("repetition")), *_unforeseen(figures.get("unforeseen_nm"))]


def _unforeseen(left_nm: float | None) -> list[str]:
    """What the model explains of its own record and leaves out where it predicts."""
    if not left_nm:
        return []
    causes = "hum, slow zero, tremor, efforts"
    return [f"On held-out pulses {left_nm:.3g} N·m cannot be foreseen ({causes}): it is left out."]


def _repeating(found: Mapping[str, Any] | None) -> list[str]:
    if not found:
        return []
    needed = ("rms_nm",) if found["found_by"] == "estimate" else ("found_by", "rms_nm", "repeats")
    if None in map(found.get, needed):
        return ["Nothing repeats, and the record rests too little: what no model can foresee is not known."]
    share, between = _share(found["explained_percent"]), f"{found['rms_nm']:.3g}"
    if found["found_by"] == "estimate":
        at_rest = f"Nothing repeats exactly. At rest the mean torque of a pulse interval scatters by {between} N·m"
        if floor_nm(found) is None:
            return [f"{at_rest}; in such means the model's error is smaller."]
        lines = [f"{at_rest}: so much at least no model can foresee."]
        return [*lines, TOO_LARGE if share is None else f"The model explains {share} of all other variance."]
    lines = [f"Between {found['repeats']:.3g} repeats of the same pulses the torque differs by {between} N·m."]
    lines.append(TOO_LARGE if share is None else f"The model explains {share} of the variance that repeats.")
    errors = [found["held_out_rms_nm"], found["held_out_model_rms_nm"]]
    if None not in errors:
        plain, model = (f"{error:.3g}" for error in errors)
        lines.append(f"Held out, the mean of the other repeats errs by {plain} N·m, the model by {model} N·m.")
    return lines


def held_out_pulses(figures: Mapping[str, Any]) -> str:
    """The pulses whose errors these are, in a sentence."""
    return "parts left out in turn" if figures.get("held_out_by") == "cross-validation" else "held-out pulses"


def floor_nm(found: Mapping[str, Any]) -> float | None:
    """What no model can foresee, N·m; None where the model errs by less: the torque at rest then changes as it says."""
    scatter_nm = found.get("rms_nm")
    if found.get("found_by") == "estimate" and scatter_nm and (found.get("model_rms_nm") or math.inf) < scatter_nm:
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
