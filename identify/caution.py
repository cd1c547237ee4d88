"""A warning against the result of a diagnosis, from the values of the result alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

WITHIN_NOISE = 2.5
"""Error on held-out rows, divided by all noise, up to which there is no warning; slow noise alone gives 1.4."""


OPEN = 0.5
"""Probability that nothing is missing, below which it is left open."""


def only_open(found: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The best candidate (a row of `candidates`) if a good record leaves open whether it is missing; else None.

    Beside a structure that explains much, an effect is only named if it explains a share of that: less may also come
    from the inexact form of the effects in the structure. The record does not show then that nothing is missing.
    """
    tried = found.get("candidates") or ()
    if found["verdict"] != "nothing_missing" or _beyond_noise(found) or not (tried and tried[0]):
        return None
    return tried[0][0] if found.get("probability", 1.0) < OPEN else None


def caution(found: Mapping[str, Any]) -> str:
    """A warning if the verdict is "nothing is missing" although the record does not show that.

    The error on held-out rows is larger than the noise, or the best candidate explains too much to be excluded.
    """
    if found["verdict"] != "nothing_missing":
        return ""
    best = only_open(found)
    if best is None:
        return _beyond_noise(found)
    return (
        f"{best['effect']}: log evidence would rise by {best['log_evidence_gain']:.0f} with it, too little to name it "
        "and too much to exclude it. This record cannot tell whether it is missing."
    )


def _beyond_noise(found: Mapping[str, Any]) -> str:
    error_nm = (found.get("base") or {}).get("held_out_rms_nm")
    noise_nm = math.hypot(found["noise_sd_nm"], (found.get("slow_noise") or {}).get("sd_nm") or 0.0)
    if error_nm is None or not error_nm > WITHIN_NOISE * noise_nm > 0.0:
        return ""
    return (
        f"On rows that were not fitted the error is {error_nm / noise_nm:.1f} times the noise, and no effect of the "
        "library has enough evidence. A longer record with PRBS, ramp and validate may show what is missing."
    )
