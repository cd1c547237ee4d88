"""A warning against the result of a diagnosis, from the values of the result alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

WITHIN_NOISE = 2.5
"""Error on held-out rows, divided by all noise, up to which there is no warning; slow noise alone gives 1.4."""


def caution(found: Mapping[str, Any]) -> str:
    """A warning if the verdict is "nothing is missing" although the error on held-out rows is larger than the noise."""
    if found["verdict"] != "nothing_missing":
        return ""
    error_nm = (found.get("base") or {}).get("held_out_rms_nm")
    noise_nm = math.hypot(found["noise_sd_nm"], (found.get("slow_noise") or {}).get("sd_nm") or 0.0)
    if error_nm is None or not error_nm > WITHIN_NOISE * noise_nm > 0.0:
        return ""
    return (
        f"On rows that were not fitted the error is {error_nm / noise_nm:.1f} times the noise: this record is too "
        f"short "
        "or too poor to show whether something is missing. Record PRBS, ramp and validate."
    )
