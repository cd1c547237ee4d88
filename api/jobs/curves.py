"""What pages draw of a recording, rounded: curves beside a model's, a comparison, a sealed recording as it was made."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.record_files import Progress
from stimrig.identify.criticism import POINTS
from stimrig.identify.json_text import json_value

BINS = 1000
"""Each bin keeps its lowest and its highest torque: no peak is lost."""

NUMBERS = (
    "torque/time_s", "torque/torque_nm", "pulses/planned_time_s", "pulses/sent_pulse_width_us", "segments/start_s",
    "segments/end_s",
)  # fmt: skip
ANGLES = ("angle/time_s", "angle/angle_rad")
"""Only of a rig with an angle sensor."""


def page_curves(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """The curves a page draws: measured, predicted, commanded, and the step response."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data))
    progress(0.5, "predicting")
    return json_value(curves(identify.Model.from_json(model_json), record))


def comparison(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """Measurement against model: identify's comparison, its series rounded."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data))
    model = identify.Model.from_json(model_json)
    progress(0.4, "comparing")
    return rounded(identify.compare(model, record).to_dict())


def rounded(comparison: dict[str, Any]) -> dict[str, Any]:
    """A comparison whose series hold five digits each."""
    series = comparison.get("series") or {}
    short = {key: _rounded(values) if isinstance(values, list) else values for key, values in series.items()}
    return {**comparison, "series": short}


def _rounded(values: list[Any]) -> list[Any]:
    return [round(value, 5) if isinstance(value, float) else value for value in values]


def curves(model: Any, record: Any) -> dict[str, Any]:
    """The measured, predicted and commanded curves, rounded to what a screen shows."""
    predicted = np.asarray(identify.predict(model, record))
    time_s, torque_nm = np.asarray(record.time_s), np.asarray(record.torque_nm)
    step = max(1, math.ceil(len(time_s) / POINTS))
    pick = slice(None, None, step)
    return {
        "time_s": time_s[pick].round(5).tolist(),
        "torque_nm": torque_nm[pick].round(5).tolist(),
        "predicted_torque_nm": predicted[pick].round(5).tolist(),
        "pulse_width_us": np.asarray(record.pulse_width_us)[pick].round(2).tolist(),
        "segments": segments_of(record),
        "step_response": step_response(model.to_dict()),
    }


def segments_of(record: Any) -> list[dict[str, Any]]:
    """The segments of a record, each with its name and times."""
    return runs([str(record.segment_names[index]) for index in record.segment], np.asarray(record.time_s))


def runs(labels: list[str], time_s: Any) -> list[dict[str, Any]]:
    """Stretches of rows that carry the same segment's name."""
    stretches: list[dict[str, Any]] = []
    for index, label in enumerate(labels):
        if not stretches or stretches[-1]["name"] != label:
            stretches.append({"name": label, "start_s": float(time_s[index])})
        stretches[-1]["end_s"] = float(time_s[index])
    return stretches


def step_response(document: dict[str, Any], seconds: float = 4.0) -> dict[str, list[float]]:
    """The linear part's answer to a unit step (eq. 2 of the paper: B(q)/A(q)), rounded."""
    from scipy.signal import lfilter

    linear, rate_hz = document["linear"], float(document["sample_rate_hz"])
    count = max(2, round(seconds * rate_hz))
    response = np.asarray(lfilter(linear["b"], linear["a"], np.ones(count)))
    delay = int(linear.get("delay_samples", 0))
    # A pulse may act up to a sample before it is written down: then the response begins within itself.
    response = np.concatenate([np.zeros(max(delay, 0)), response[max(-delay, 0) :]])[:count]
    pick = slice(None, None, max(1, count // 400))
    return {"time_s": (np.arange(response.size) / rate_hz)[pick].tolist(), "response": response[pick].round(6).tolist()}


def recorded(data: str, progress: Progress) -> dict[str, Any]:
    """Torque over time, rounded; each change of the pulse width that was sent; None where a pulse was dropped.

    With an angle sensor also the joint's angle, °.
    """
    progress(0.1, "reading the recording")
    columns = _columns(Path(data))
    time_s, torque_nm = columns["torque/time_s"], columns["torque/torque_nm"]
    known = np.isfinite(torque_nm) & np.isfinite(time_s)
    time_s, torque_nm = _envelope(time_s[known], torque_nm[known])
    pulses = _changes(columns["pulses/planned_time_s"], columns["pulses/sent_pulse_width_us"], columns["rate_hz"])
    rows = zip(columns["segments/name"], columns["segments/start_s"], columns["segments/end_s"], strict=True)
    return {
        "time_s": time_s,
        "torque_nm": torque_nm,
        "pulse_time_s": [at_s for at_s, _ in pulses],
        "sent_pulse_width_us": [width_us for _, width_us in pulses],
        "pulses_end_s": pulses[-1][0] if pulses else 0.0,
        **_angle(columns),
        "segments": [{"name": str(name), "start_s": float(start), "end_s": float(end)} for name, start, end in rows],
    }


def _columns(path: Path) -> dict[str, Any]:
    import h5py

    columns: dict[str, Any] = {}
    with h5py.File(path) as file:
        for name in NUMBERS:
            columns[name] = np.asarray(file[name], float)
        columns |= {name: np.asarray(file[name], float) for name in ANGLES if name in file}
        names: Any = file["segments/name"]
        columns["segments/name"] = names.asstr()[:]
        columns["rate_hz"] = float(np.asarray(file.attrs["pulse_rate_hz"]))
    return columns


def _angle(columns: dict[str, Any]) -> dict[str, Any]:
    """The joint's angle, °, rounded; nothing where it was not recorded."""
    if not set(columns) >= set(ANGLES) or not columns[ANGLES[0]].size:
        return {}
    time_s, angle_rad = (columns[name] for name in ANGLES)
    known = np.isfinite(time_s) & np.isfinite(angle_rad)
    time_s, angle_deg = _envelope(time_s[known], np.degrees(angle_rad[known]))
    return {"angle_time_s": time_s, "angle_deg": angle_deg}


def _changes(due_s: Any, sent_us: Any, rate_hz: float) -> list[tuple[float, float | None]]:
    """When the pulse width became another one, and at last when the pulses ended; what was before a dropped pulse
    reaches to it."""
    if not due_s.size:
        return []
    changed = np.flatnonzero(np.append(True, np.diff(np.nan_to_num(sent_us, nan=-1.0)) != 0))
    widths_us = [float(sent_us[k]) if np.isfinite(sent_us[k]) else None for k in changed]
    times_s = [float(due_s[k]) for k in changed]
    changes = list(zip(times_s, widths_us, strict=True))
    for k in reversed(range(1, len(changes))):
        if changes[k][1] is None:
            changes.insert(k, (changes[k][0], changes[k - 1][1]))
    return [*changes, (float(due_s[-1]) + 1.0 / rate_hz, widths_us[-1])]


def _envelope(time_s: Any, torque_nm: Any) -> tuple[list[float], list[float]]:
    """The lowest and the highest sample of each bin, in their order."""
    if time_s.size > 2 * BINS:
        parts = np.array_split(np.arange(time_s.size), BINS)
        picked = sorted({int(part[pick(torque_nm[part])]) for part in parts for pick in (np.argmin, np.argmax)})
        time_s, torque_nm = time_s[picked], torque_nm[picked]
    return time_s.round(4).tolist(), torque_nm.round(4).tolist()
