"""A sealed recording of the rig's own as a page draws it: what was measured and what was sent, no model needed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

BINS = 1000
"""Each bin keeps its lowest and its highest torque: no peak is lost."""

NUMBERS = (
    "torque/time_s", "torque/torque_nm", "pulses/planned_time_s", "pulses/sent_pulse_width_us", "segments/start_s",
    "segments/end_s",
)  # fmt: skip
ANGLES = ("angle/time_s", "angle/angle_rad")
"""Only of a rig with an angle sensor."""


def recorded(data: str, progress: Callable[[float, str], None]) -> dict[str, Any]:
    """Torque over time, thinned; each change of the pulse width that was sent; None where a pulse was dropped.

    With an angle sensor also the joint's angle, °.
    """
    progress(0.1, "reading the recording")
    held = _columns(Path(data))
    time_s, torque_nm = held["torque/time_s"], held["torque/torque_nm"]
    known = np.isfinite(torque_nm) & np.isfinite(time_s)
    time_s, torque_nm = _envelope(time_s[known], torque_nm[known])
    pulses = _changes(held["pulses/planned_time_s"], held["pulses/sent_pulse_width_us"], held["rate_hz"])
    rows = zip(held["segments/name"], held["segments/start_s"], held["segments/end_s"], strict=True)
    return {
        "time_s": time_s,
        "torque_nm": torque_nm,
        "pulse_time_s": [at_s for at_s, _ in pulses],
        "sent_pulse_width_us": [width_us for _, width_us in pulses],
        "pulses_end_s": pulses[-1][0] if pulses else 0.0,
        **_angle(held),
        "segments": [{"name": str(name), "start_s": float(start), "end_s": float(end)} for name, start, end in rows],
    }


def _columns(path: Path) -> dict[str, Any]:
    import h5py

    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        for name in NUMBERS:
            found[name] = np.asarray(file[name], float)
        found |= {name: np.asarray(file[name], float) for name in ANGLES if name in file}
        names: Any = file["segments/name"]
        found["segments/name"] = names.asstr()[:]
        found["rate_hz"] = float(np.asarray(file.attrs["pulse_rate_hz"]))
    return found


def _angle(held: dict[str, Any]) -> dict[str, Any]:
    """The joint's angle, °, thinned; nothing where it was not recorded."""
    if not set(held) >= set(ANGLES) or not held[ANGLES[0]].size:
        return {}
    time_s, angle_rad = (held[name] for name in ANGLES)
    known = np.isfinite(time_s) & np.isfinite(angle_rad)
    time_s, angle_deg = _envelope(time_s[known], np.degrees(angle_rad[known]))
    return {"angle_time_s": time_s, "angle_deg": angle_deg}


def _changes(due_s: Any, sent_us: Any, rate_hz: float) -> list[tuple[float, float | None]]:
    """When the pulse width became another one, and at last when the pulses ended; what was before a dropped pulse
    reaches to it."""
    if not due_s.size:
        return []
    kept = np.flatnonzero(np.append(True, np.diff(np.nan_to_num(sent_us, nan=-1.0)) != 0))
    widths_us = [float(sent_us[k]) if np.isfinite(sent_us[k]) else None for k in kept]
    times_s = [float(due_s[k]) for k in kept]
    found = list(zip(times_s, widths_us, strict=True))
    for k in reversed(range(1, len(found))):
        if found[k][1] is None:
            found.insert(k, (found[k][0], found[k - 1][1]))
    return [*found, (float(due_s[-1]) + 1.0 / rate_hz, widths_us[-1])]


def _envelope(time_s: Any, torque_nm: Any) -> tuple[list[float], list[float]]:
    """The lowest and the highest sample of each bin, in their order."""
    if time_s.size > 2 * BINS:
        parts = np.array_split(np.arange(time_s.size), BINS)
        picked = sorted({int(part[pick(torque_nm[part])]) for part in parts for pick in (np.argmin, np.argmax)})
        time_s, torque_nm = time_s[picked], torque_nm[picked]
    return time_s.round(4).tolist(), torque_nm.round(4).tolist()
