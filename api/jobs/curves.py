"""Rounded curves of a recording for pages: beside a model's, in a comparison, or of the sealed recording alone."""

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
    series = {
        key: [round(value, 5) if isinstance(value, float) else value for value in values]
        if isinstance(values, list) else values
        for key, values in comparison["series"].items()
    }  # fmt: skip
    return {**comparison, "series": series}


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
        "segments": runs([record.segment_names[index] for index in record.segment], time_s),
        "step_response": step_response(model.to_dict()),
    }


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
    """Return torque over time, rounded, the widths of the pulses that were sent (None: dropped), and the segments.

    With an angle sensor also the joint's angle, °.
    """
    import h5py

    progress(0.1, "reading the recording")
    with h5py.File(data) as file:
        tables: Any = {name: {key: table[()] for key, table in group.items()} for name, group in file.items()}
        names: Any = file["segments/name"]
        labels, rate_hz = names.asstr()[:], float(np.asarray(file.attrs["pulse_rate_hz"]))
    pulses, spans, curves = tables["pulses"], tables["segments"], {}
    for table, source, name, factor in (
        ("torque", "torque_nm", "torque_nm", 1.0), ("angle", "angle_rad", "angle_deg", 180 / math.pi),
    ):  # fmt: skip
        if tables.get(table):
            curves[name] = _envelope(tables[table]["time_s"], factor * tables[table][source])
    due_s, widths_us = pulses["planned_time_s"].tolist(), pulses["sent_pulse_width_us"].tolist()
    end_s = due_s[-1] + 1.0 / rate_hz if due_s else 0.0
    widths_us = [width_us if math.isfinite(width_us) else None for width_us in [*widths_us, *widths_us[-1:]]]
    angle = curves.get("angle_deg")
    return {
        "time_s": curves["torque_nm"][0],
        "torque_nm": curves["torque_nm"][1],
        "pulse_time_s": [*due_s, end_s] if due_s else [],
        "sent_pulse_width_us": widths_us,
        "pulses_end_s": end_s,
        **({"angle_time_s": angle[0], "angle_deg": angle[1]} if angle and angle[0] else {}),
        "segments": [
            {"name": str(name), "start_s": float(start), "end_s": float(end)}
            for name, start, end in zip(labels, spans["start_s"], spans["end_s"], strict=True)
        ],
    }


def _envelope(time_s: Any, values: Any) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest known sample of each bin, in their order."""
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(time_s))
    if known.size > 2 * BINS:
        parts = np.array_split(known, BINS)
        known = sorted({int(part[pick(values[part])]) for part in parts for pick in (np.argmin, np.argmax)})
    return time_s[known].round(4).tolist(), values[known].round(4).tolist()
