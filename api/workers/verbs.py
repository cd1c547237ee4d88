"""What a worker process does, verb by verb: paths and plain objects in, plain objects out.

Imported by the worker only; the web process never loads numpy, and never fits.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.workers import adaptive_verbs, tracking_verbs
from stimrig.api.workers.diagnosis_verbs import diagnosis, improve, joined
from stimrig.api.workers.json_values import clean
from stimrig.api.workers.prediction import forecast, invert
from stimrig.api.workers.recorded_signals import recorded
from stimrig.identify.records.cells import quoted
from stimrig.identify.records.join import write_joined
from stimrig.identify.records.recording import attributes

Progress = Callable[[float, str], None]
POINTS = 2400
"""Most points in a drawn curve: more than a screen has pixels."""


def fit(
    data: str,
    progress: Progress,
    method: str = "maximum-likelihood",
    effects: tuple[str, ...] | list[str] = (),
    fit_on: list[str] | None = None,
    recruitment: str | None = None,
    models: Sequence[str] = (),
) -> dict[str, Any]:
    """Read a recording and identify; the model document as JSON text and as an object, and what was assumed.

    With `recruitment` near-sigmoid, `models` are the person's approved ones, oldest first.
    """
    progress(0.05, "reading the recording")
    record = identify.read(Path(data))
    progress(0.2, "identifying")

    def further(share: float, text: str = "") -> None:
        progress(0.2 + 0.8 * share, text)

    options: dict[str, Any] = {} if recruitment is None else {"recruitment": recruitment}
    if earlier := adaptive_verbs.known(models).get("earlier"):
        options["earlier"] = earlier
    model = identify.fit(record, method=method, effects=tuple(effects), fit_on=fit_on, progress=further, **options)
    return {
        "json": model.to_json(),
        "model": model.to_dict(),
        "notes": list(record.notes),
        "of": record.source.participant,
    }


def figures(progress: Progress, model_json: str) -> dict[str, Any]:
    """Threshold, plateau and dynamics with their standard deviations, of a model from before these were stored."""
    progress(0.1, "reading the model")
    return clean({"figures": identify.Model.from_json(model_json).figures()})


def carry(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """The structure of an earlier model on a new recording: the finding, and the carried model where there is one."""
    record = identify.read(Path(data))
    found = identify.carry(record, identify.Model.from_json(model_json), progress)
    return {"json": found.models[1].to_json() if len(found.models) > 1 else None, "found": clean(found.finding())}


def drawn(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """The curves a page draws: measured, predicted, commanded, and the step response."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data))
    progress(0.5, "predicting")
    return clean(curves(identify.Model.from_json(model_json), record))


def comparison(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """Measurement against model: identify's comparison, its series thinned."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data))
    model = identify.Model.from_json(model_json)
    progress(0.4, "comparing")
    return thinned(identify.compare(model, record).to_dict())


def thinned(found: dict[str, Any]) -> dict[str, Any]:
    """A comparison whose series hold no more points than a screen shows, five digits each."""
    series = found.get("series") or {}
    longest = max((len(values) for values in series.values() if isinstance(values, list)), default=0)
    pick = slice(None, None, max(1, math.ceil(longest / POINTS)))
    short = {key: _rounded(values[pick]) if isinstance(values, list) else values for key, values in series.items()}
    return {**found, "series": short}


def _rounded(values: list[Any]) -> list[Any]:
    return [round(value, 5) if isinstance(value, float) else value for value in values]


def curves(model: Any, record: Any) -> dict[str, Any]:
    """The measured, predicted and commanded curves, thinned to what a screen shows."""
    predicted = np.asarray(identify.predict(model, record))
    time_s, torque_nm = np.asarray(record.time_s), np.asarray(record.torque_nm)
    step = max(1, math.ceil(len(time_s) / POINTS))
    labels = [str(record.segment_names[index]) for index in record.segment]
    pick = slice(None, None, step)
    return {
        "time_s": time_s[pick].round(5).tolist(),
        "torque_nm": torque_nm[pick].round(5).tolist(),
        "predicted_torque_nm": predicted[pick].round(5).tolist(),
        "pulse_width_us": np.asarray(record.pulse_width_us)[pick].round(2).tolist(),
        "segments": runs(labels, time_s),
        "step_response": step_response(model.to_dict()),
    }


def runs(labels: list[str], time_s: Any) -> list[dict[str, Any]]:
    """Stretches of rows that carry the same segment's name."""
    found: list[dict[str, Any]] = []
    for index, label in enumerate(labels):
        if not found or found[-1]["name"] != label:
            found.append({"name": label, "start_s": float(time_s[index])})
        found[-1]["end_s"] = float(time_s[index])
    return found


def step_response(document: dict[str, Any], seconds: float = 4.0) -> dict[str, list[float]]:
    """The linear part's answer to a unit step (eq. 2 of the paper: B(q)/A(q)), thinned."""
    from scipy.signal import lfilter

    linear, rate_hz = document["linear"], float(document["sample_rate_hz"])
    count = max(2, round(seconds * rate_hz))
    response = np.asarray(lfilter(linear["b"], linear["a"], np.ones(count)))
    delay = int(linear.get("delay_samples", 0))
    # A pulse may act up to a sample before it is written down: then the response begins within itself.
    response = np.concatenate([np.zeros(max(delay, 0)), response[max(-delay, 0) :]])[:count]
    pick = slice(None, None, max(1, count // 400))
    return {"time_s": (np.arange(response.size) / rate_hz)[pick].tolist(), "response": response[pick].round(6).tolist()}


def effects(progress: Progress) -> dict[str, Any]:
    """The library of effects."""
    from stimrig.identify import effects as library

    progress(0.5, "reading the library")
    return clean({"effects": library.library()})


def warm(progress: Progress) -> dict[str, Any]:
    """Load identify and its compiled parts, so that the fit after a test starts at once."""
    from stimrig.identify.records.csv import read_csv

    progress(0.1, "loading")
    identify.fit(read_csv(_warm_csv().encode(), Path("warm.csv")))
    adaptive_verbs.warm()
    return {}


def _warm_csv() -> str:
    """A small made-up record, only to have every compiled part compiled: a lag behind a switching input."""
    rows, torque = ["time_s,pulse_width_us,torque_nm,segment"], 0.0
    for index in range(800):
        seconds = index / 40
        level = (
            0.0 if seconds < 1 else 200.0 * (index // 13 % 2) if seconds < 9 else max(0.0, 200 - 40 * abs(seconds - 14))
        )
        torque += (level / 40 - torque) / 20
        name = "rest" if seconds < 1 else "prbs" if seconds < 9 else "ramp"
        wobble = 0.03 * math.sin(index * index * 0.7)
        rows.append(f"{seconds:.4f},{level:.1f},{torque + wobble:.5f},{name}")
    return "\n".join(rows) + "\n"


def plain_csv(data: str, progress: Progress, out: str, columns: list[str]) -> dict[str, Any]:
    """A table or MAT file of another tool as a CSV file in our own layout, by what `--map` says of its columns."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data), map=columns)
    progress(0.7, "writing")
    write_joined(record, Path(out))
    return {"notes": list(record.notes), "of": record.source.participant}


def export_csv(data: str, progress: Progress, out: str) -> dict[str, Any]:
    """A recording as a CSV file in the layout that `identify.read` takes in (docs/recording.md's times and widths)."""
    progress(0.1, "reading the recording")
    record = identify.read(Path(data))
    if len(record.parts) > 1:
        progress(0.7, "writing")
        write_joined(record, Path(out))
        return {"rows": int(record.time_s.size)}
    if abs(record.pulse_rate_hz - 40.0) > 1e-6:
        message = f"{record.pulse_rate_hz:g} pulses/s; a CSV file would be read as 40"
        raise identify.BadRecord(message, fix="Take the HDF5 file.")
    names = ["time_s", "pulse_width_us", "torque_nm"]
    also = record.columns()
    columns = [column.tolist() for column in (*(getattr(record, name) for name in names), *also.values())]
    told = [quoted(name) for name in record.segment_names]
    segments = [told[index] for index in record.segment.tolist()]
    progress(0.7, "writing")
    with Path(out).open("w", encoding="utf-8", newline="") as file:
        file.write(",".join([*names, "segment", *also]) + "\n")
        for seconds, *values, segment in zip(*columns, segments, strict=True):
            width, torque, *more = [f"{value:.8g}" for value in values]
            file.write(",".join([f"{seconds:.6f}", width, torque, segment, *more]) + "\n")
    return {"rows": len(segments)}


def find_recording(progress: Progress, folder: str, test_id: str) -> dict[str, Any]:
    """The sealed recording of a test, when the service did not hear of its end."""
    from stimrig.api.store.uploads import PREFIX

    progress(0.1, "looking through the recordings")
    for path in sorted(Path(folder).glob("**/*.h5")):
        if path.name.startswith(PREFIX):
            continue  # what somebody sent in is no recording of this rig, whatever test it names
        try:
            found = attributes(path, ["test_id", "recording_id", "outcome", "reason"])
        except identify.IdentifyError:
            continue
        if found.pop("test_id") == test_id:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            return {"found": {**found, "recording_path": str(path), "file_sha256": digest}}
    return {"found": None}


OWN = (
    fit, carry, comparison, figures, diagnosis, improve, effects, warm, forecast, invert, export_csv, plain_csv,
    find_recording, recorded,
)  # fmt: skip
VERBS: dict[str, Callable[..., dict[str, Any]]] = {
    **{verb.__name__: verb for verb in OWN},
    "curves": drawn,
    "join": joined,
    **adaptive_verbs.VERBS,
    **tracking_verbs.VERBS,
}
