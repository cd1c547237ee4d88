"""What stands against a diagnosis, read off its own figures; needs nothing but them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

WITHIN_NOISE = 2.5
"""Error on rows not fitted, over all the noise, up to which nothing stands against it: slow noise alone gives 1.4."""


def caution(found: Mapping[str, Any]) -> str:
    """What stands against "nothing is missing" in a diagnosis: an error on rows not fitted beyond all noise."""
    if found["verdict"] != "nothing_missing":
        return ""
    error_nm = (found.get("base") or {}).get("held_out_rms_nm")
    noise_nm = math.hypot(found["noise_sd_nm"], (found.get("slow_noise") or {}).get("sd_nm") or 0.0)
    if error_nm is None or not error_nm > WITHIN_NOISE * noise_nm > 0.0:
        return ""
    return (
        f"On rows not fitted the error is {error_nm / noise_nm:.1f} times the noise: this record is too short or too "
        "poor to tell whether something is missing. Record PRBS, ramp and validate."
    )
