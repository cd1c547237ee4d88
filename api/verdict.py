"""How good a model is, in words: its error on rows it has not seen, beside the ceiling the noise allows."""

from __future__ import annotations

from typing import Any

GOOD_GAP, USABLE_GAP = 2.0, 8.0
"""Per cent of fit below the ceiling: up to the first it is good, up to the second usable."""


def figures(document: dict[str, Any]) -> dict[str, Any]:
    """The few numbers of a MODEL.json a person looks at first."""
    fit = document.get("fit") or {}
    names = (
        "fit_percent", "ceiling_percent", "held_out_fit_percent", "held_out_ceiling_percent",
        "rms_nm", "held_out_rms_nm", "noise_sd_nm",
    )  # fmt: skip
    return {name: fit.get(name) for name in names}


def quality(fit: dict[str, Any]) -> dict[str, Any]:
    """A verdict and its sentence.

    Parameters
    ----------
    fit : dict
        As `figures` gives it; percentages.

    Returns
    -------
    dict
        ``verdict`` (good, usable, poor, unknown) and ``words``.
    """
    held_out = fit.get("held_out_fit_percent")
    reached, of = (
        (held_out, "on rows it has not seen") if held_out is not None else (fit.get("fit_percent"), "on its own rows")
    )
    ceiling = fit.get("held_out_ceiling_percent") if held_out is not None else None
    ceiling = ceiling if ceiling is not None else fit.get("ceiling_percent")
    if reached is None:
        return {"verdict": "unknown", "words": "No fit figure was stored with this model."}
    if ceiling is None:
        return {"verdict": "unknown", "words": f"Fit {reached:.1f} % {of}; the ceiling is not known."}
    gap = ceiling - reached
    verdict = "good" if gap <= GOOD_GAP else "usable" if gap <= USABLE_GAP else "poor"
    advice = {
        "good": "Little is left to explain.",
        "usable": "Something is missing in it; look at where it fails before relying on it.",
        "poor": "Do not rely on it: compare it with the measurement, and see what is missing.",
    }[verdict]
    return {"verdict": verdict, "words": f"Fit {reached:.1f} % {of}; the noise allows {ceiling:.1f} %. {advice}"}
