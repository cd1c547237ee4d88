"""Sentences on what repeats in a record, from the values of `repetition` in a fit alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TOO_LARGE = "Beside the torque that is too much to tell a share that the model explains."


def repetition_sentences(figures: Mapping[str, Any]) -> list[str]:
    """What repetition says cannot be better, and how much of what repeats the model explains.

    Parameters
    ----------
    figures : Mapping
        Fit statistics; `repetition` as `identify.estimation.repetition` gives it. Models of older versions have none.
    """
    return [*_repeating(figures.get("repetition")), *_unforeseen(figures.get("unforeseen_nm"))]


def _unforeseen(left_nm: float | None) -> list[str]:
    """What the model explains of its own record and leaves out where it predicts."""
    if not left_nm:
        return []
    return [f"On held-out rows {left_nm:.3g} N·m cannot be foreseen (hum, slow zero, tremor, efforts): it is left out."]


def _repeating(found: Mapping[str, Any] | None) -> list[str]:
    if not found:
        return []
    needed = ("rms_nm",) if found["found_by"] == "estimate" else ("found_by", "rms_nm", "repeats")
    if None in map(found.get, needed):
        return ["Nothing repeats, and the record rests too little: what no model can foresee is not known."]
    share, between = found["explained_percent"], f"{found['rms_nm']:.3g}"
    if found["found_by"] == "estimate":
        lines = [
            f"Nothing repeats exactly. At rest the torque scatters by {between} N·m in the mean of a pulse interval: "
            "so much at least no model can foresee."
        ]
        return [*lines, TOO_LARGE if share is None else f"The model explains {share:.1f} % of all other variance."]
    lines = [f"Between {found['repeats']:.3g} repeats of the same pulses the torque differs by {between} N·m."]
    lines.append(TOO_LARGE if share is None else f"The model explains {share:.1f} % of the variance that repeats.")
    errors = [found["held_out_rms_nm"], found["held_out_model_rms_nm"]]
    if None not in errors:
        plain, model = (f"{error:.3g}" for error in errors)
        lines.append(f"Held out, the mean of the other repeats errs by {plain} N·m, the model by {model} N·m.")
    return lines


def repetition_words(figures: Mapping[str, Any]) -> str:
    """The same in one line; a dash where nothing is said."""
    return " ".join(repetition_sentences(figures)) or "–"
