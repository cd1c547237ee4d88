"""Units in which other tools write a record's columns, and the factors to the units of ours."""

from __future__ import annotations

import math

_TIME = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "µs": 1e-6, "us": 1e-6, "min": 60.0}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180}
_ANGLE["°"] = _ANGLE["deg"]
_FOOT_POUND_NM = 1.3558179483314004
_FOOT_POUNDS = dict.fromkeys(("lbft", "lbfft", "ftlb", "ftlbf"), _FOOT_POUND_NM)
_INCH_POUNDS = dict.fromkeys(("lbin", "lbfin", "inlb", "inlbf"), _FOOT_POUND_NM / 12)
UNITS: dict[str, dict[str, float]] = {
    "time_s": _TIME,
    "pulse_width_us": {"µs": 1.0, "us": 1.0, "ms": 1e3, "s": 1e6, "ns": 1e-3},
    "torque_nm": {"nm": 1.0, "mnm": 1e-3, "ncm": 1e-2, "nmm": 1e-3, "knm": 1e3, **_FOOT_POUNDS, **_INCH_POUNDS},
    "angle_rad": _ANGLE,
    "velocity_rad_s": {f"{unit}/{per}": factor for unit, factor in _ANGLE.items() for per in ("s", "sec")}
    | {"rpm": 2 * math.pi / 60},
    "late_s": _TIME,
    "doubted": {"1": 1.0},
    "segment": {},
}
"""For each column the units that are known, as `plain` writes them, with the factor to the column's own unit."""
SHOWN = {
    "time_s": ("s", "ms", "µs"),
    "pulse_width_us": ("µs", "ms", "s"),
    "torque_nm": ("Nm", "mNm", "Ncm"),
    "angle_rad": ("rad", "deg"),
    "velocity_rad_s": ("rad/s", "deg/s", "rpm"),
    "late_s": ("s", "ms", "µs"),
}
"""The usual ones, the column's own first: what messages offer."""
_NO_SIGNS = str.maketrans({"μ": "µ", **dict.fromkeys("·⋅∙*. []()", None)})


def plain(unit: str) -> str:
    """A unit without brackets, dots and capitals: 'N·m', '[Nm]' and 'N*m' are one."""
    return unit.strip().translate(_NO_SIGNS).lower()


def factor(target: str, unit: str) -> float | None:
    """By what a column's numbers are multiplied to come in its own unit; None where the unit is not known."""
    return UNITS[target].get(plain(unit))
