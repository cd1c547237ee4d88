"""Pulse widths for a reference torque: what of it is out of reach in words, and all of it as a table."""

from __future__ import annotations

from collections.abc import Sequence
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


def rows(found: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """A row for each stretch: when, how much lacks, why."""
    return [
        {
            "when": f"{_number(one['begin_s'])} to {_number(one['end_s'])} s",
            "lacks": f"{_number(one['shortfall_nm'])} N·m",
            "why": str(REASONS.get(one["reason"], one["reason"])),
        }
        for one in found
    ]


def _number(value: float) -> str:
    return f"{value:.2f}"


def table(found: dict[str, Any]) -> str:
    """Rows of a CSV file, one for each pulse."""
    columns = zip(*(found[name] for name in COLUMNS), strict=True)
    lines = [
        f"{k / found['pulse_rate_hz']:.6g},{width:g},{wanted:g},{predicted:g}"
        for k, (width, wanted, predicted) in enumerate(columns)
    ]
    return "\r\n".join([",".join(["time_s", *COLUMNS]), *lines, ""])
