"""Worst places of a model, and the error of a later model there, from stored comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

HEALED = 1.3
"""Largest ratio of error to noise at a place that counts as healed."""


def stands_out(comparison: Mapping[str, Any]) -> bool:
    """Return true if the error on held-out pulses (all, without such) exceeds the noise; else the places are noise.

    `comparison`: the keys of `compare --json`.
    """
    error_nm, noise_nm = (comparison.get("held_out") or comparison).get("rms_nm"), comparison.get("noise_sd_nm")
    return error_nm is not None and noise_nm is not None and error_nm > HEALED * noise_nm


def looks_like_noise(comparison: Mapping[str, Any]) -> bool:
    """Return true if neither the error nor a correlation of the residual stands out."""
    tests = (comparison.get("tests") or {}).get("tests") or []
    return not stands_out(comparison) and all(test["passed"] for test in tests)


def healed_places(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The worst places of a comparison, each with the error there before and after.

    `before`, `after`: the keys of `compare --json`, of two models and the same record; the series may be thinned.
    Returns rows with the keys of `where`, and `before_nm`, `after_nm` (rms of measured minus model, N·m), `noise_nm`,
    and `healed`: whether the error left there is not larger than the noise explains.
    """
    noise_nm = max(before["noise_sd_nm"], after["noise_sd_nm"])
    rows = []
    for place in before.get("where") or []:
        errors = []
        for series in (before["series"], after["series"]):
            pairs = zip(series["time_s"], series["residual_nm"], strict=True)
            start_s, end_s = place["start_s"], place["end_s"]
            squares = [value * value for time_s, value in pairs if start_s <= time_s <= end_s and value is not None]
            errors.append(math.sqrt(sum(squares) / max(len(squares), 1)))
        healed = errors[1] <= HEALED * noise_nm
        rows.append({**place, "before_nm": errors[0], "after_nm": errors[1], "noise_nm": noise_nm, "healed": healed})
    return rows


def place_words(place: Mapping[str, Any]) -> str:
    """Describe the change of the error at a place."""
    before, after, noise = (f"{place[name]:.3g}" for name in ("before_nm", "after_nm", "noise_nm"))
    rose = place["after_nm"] > place["before_nm"]
    change = f"{'rose' if rose else 'fell'} from {before} to {after} N·m"
    if before == after or rose or place["healed"]:
        change = f"is {after} N·m, as before" if before == after else change
        return f"the error there {change}; the noise is {noise} N·m."
    return f"the error there {change}, which is more than the noise of {noise} N·m."
