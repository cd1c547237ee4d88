"""Sentences on what repeats in a record, from the values of `repetition` in a fit alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def repetition_sentences(figures: Mapping[str, Any]) -> list[str]:
    """What repetition says cannot be better, and how much of what repeats the model explains.

    Parameters
    ----------
    figures : Mapping
        Fit statistics; `repetition` as `identify.estimation.repetition` gives it. Models of older versions have none.
    """
    found = figures.get("repetition")
    if not found:
        return []
    share, between = found["explained_percent"], f"{found['rms_nm'] or 0.0:.3g}"
    if found["found_by"] is None:
        return ["Nothing repeats, and the record rests too little: what no model can foresee is not known."]
    if found["found_by"] == "estimate":
        lines = [f"Nothing repeats exactly; by the rests, an estimate, no model can foresee {between} N·m."]
        return lines if share is None else [*lines, f"The model explains {share:.1f} % of the rest."]
    lines = [f"Between {found['repeats']:.2g} repeats of the same pulses the torque differs by {between} N·m."]
    if share is not None:
        lines.append(f"The model explains {share:.1f} % of what repeats.")
    if found["held_out_rms_nm"] is not None:
        plain, model = f"{found['held_out_rms_nm']:.3g}", f"{found['held_out_model_rms_nm']:.3g}"
        lines.append(f"Held out, the mean of the other repeats errs by {plain} N·m, the model by {model} N·m.")
    return lines


def repetition_words(figures: Mapping[str, Any]) -> str:
    """The same in one line; a dash where nothing is said."""
    return " ".join(repetition_sentences(figures)) or "–"
