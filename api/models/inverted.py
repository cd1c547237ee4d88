"""Pulse widths for a reference torque: reasons why a part is out of reach, and all of it as a CSV table."""

from __future__ import annotations

from typing import Any

REASONS: dict[str, str] = {
    "above-plateau": "too high for the widest pulse",
    "below-zero": "on the other side of zero, and a muscle only pulls",
    "rises-too-fast": "rises faster than the muscle, or than pulses may widen",
    "falls-too-fast": "falls faster than the muscle lets go",
    "under-threshold": "too low: near the threshold a pulse gives too little or too much",
    "not-followed": "the muscle does something there that the pulses cannot make up for",
}

COLUMNS = ("pulse_width_us", "reference_torque_nm", "predicted_torque_nm")


def table(inversion: dict[str, Any]) -> str:
    """Write a CSV table, a row for each pulse."""
    columns = zip(*(inversion[name] for name in COLUMNS), strict=True)
    lines = [
        f"{k / inversion['pulse_rate_hz']:.6g},{width:g},{wanted:g},{predicted:g}"
        for k, (width, wanted, predicted) in enumerate(columns)
    ]
    return "\r\n".join([",".join(["time_s", *COLUMNS]), *lines, ""])
