"""Verbs of the worker processes: paths and plain objects in, plain objects out.

Imported by the worker and the command line only: the web process never fits, and loads neither scipy nor numba.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api import record_files
from stimrig.api.jobs import adaptive, tracking
from stimrig.api.jobs.curves import comparison, page_curves, recorded
from stimrig.api.record_files import Progress
from stimrig.api.structure import held_by
from stimrig.identify.json_text import json_value

SIGNATURE_POINTS = 900
"""Points of a signature's curve: it is drawn small."""


def fit(
    data: str,
    progress: Progress,
    method: str = "maximum-likelihood",
    effects: tuple[str, ...] | list[str] = (),
    fit_on: list[str] | None = None,
    recruitment: str | None = None,
    models: Sequence[str] = (),
) -> dict[str, Any]:
    """Identify a recording; return the model as JSON text and as an object, and what was assumed.

    With `recruitment` near-sigmoid, `models` are the person's approved ones, oldest first.
    """
    progress(0.05, "reading the recording")
    record = identify.read(Path(data))
    progress(0.2, "identifying")

    def further(share: float, text: str = "") -> None:
        progress(0.2 + 0.8 * share, text)

    options: dict[str, Any] = {} if recruitment is None else {"recruitment": recruitment}
    if earlier := adaptive.known(models):
        options["earlier"] = earlier.model
    model = identify.fit(record, method=method, effects=tuple(effects), fit_on=fit_on, progress=further, **options)
    return {
        "json": model.to_json(),
        "model": model.to_dict(),
        "notes": list(record.notes),
        "of": record.source.participant,
        "current_ma": record.source.current_ma,
        "samples_sha256": record_files.samples_sha256(record),
    }


def carry(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """Fit the structure of an earlier model to a new recording; return the finding, and the model if there is one."""
    record = identify.read(Path(data))
    carried = identify.carry(record, identify.Model.from_json(model_json), progress)
    text = carried.models[1].to_json() if len(carried.models) > 1 else None
    return {"json": text, "found": json_value(carried.finding())}


def diagnosis(data: str, progress: Progress, model_json: str | None = None) -> dict[str, Any]:
    """Search for what a model's structure lacks; without a model it is the plain structure.

    `improvement` holds the models of the search, and `rows` what is missing in each of them, what each effect would
    explain, and the test that decides.
    """
    record = identify.read(Path(data))
    model = None if model_json is None else identify.Model.from_json(model_json)
    diagnoses, improvement = identify.diagnose_and_improve(record, progress, model)
    structures = [held_by(model, record), *(held_by(later, record) for later in improvement.models[1:])]
    more = {"signatures": signatures(record, improvement), "refused": list(improvement.refused)}
    rows = [
        {**with_experiment(record, each, structure), **more}
        for each, structure in zip(diagnoses, structures, strict=True)
    ]
    return json_value({"rows": rows, "improvement": improvement.to_dict()})


def with_experiment(record: Any, diagnosis: Any, structure: Sequence[str]) -> dict[str, Any]:
    """Return a diagnosis with the library's entries of the effects that it names, and the next experiment."""
    from stimrig.identify.effects import library

    document: dict[str, Any] = {**diagnosis.to_dict(), "structure": list(structure)}
    named = {row["effect"] for rows in (document.get("candidates") or []) for row in rows}
    for entry in [*document["missing"], *document["free"]]:
        named |= {entry["effect"], *(entry.get("confused_with") or [])}
    document["library"] = {entry["id"]: entry for entry in library() if entry["id"] in named}
    plan = experiment(document["missing"], document["deciding_experiment"])
    # A list of widths is one of pulses: at another rate it would be another test, and could not be joined.
    document["experiment"] = None if plan is None else {**plan, "pulse_rate_hz": record.pulse_rate_hz}
    return document


def experiment(missing: Sequence[dict[str, Any]], further: dict[str, Any] | None = None) -> dict[str, Any] | None:
    """Return the `further` test for what is left, or the one that separates the first effect from its rivals."""
    from stimrig.identify.diagnosis import planned

    plan = planned(missing, further)
    return None if plan is None else {**plan.to_dict(), "effect": next(iter(plan.rivals), "")}


def signatures(record: Any, improvement: Any) -> dict[str, Any]:
    """Return what each effect explains of the residual of the model before it: measured beside expected.

    ``seen_nm`` is measurement minus the model before, averaged over a tenth of a second, so that a slow signature shows
    through the noise; ``expected_nm`` is the model with the effect minus the model before.
    """
    pick = slice(None, None, max(1, -(-record.time_s.size // SIGNATURE_POINTS)))
    width = max(1, round(0.1 * record.sample_rate_hz))
    curves: dict[str, Any] = {"time_s": record.time_s[pick].round(4)}
    torques = [np.asarray(identify.predict(model, record)) for model in improvement.models]
    for step, before, after in zip(improvement.steps[1:], torques, torques[1:], strict=False):
        padded = np.pad(record.torque_nm - before, (width // 2, width - 1 - width // 2), mode="edge")
        measured_nm, expected_nm = np.convolve(padded, np.ones(width) / width, "valid"), after - before
        curves[step["added"]] = {"seen_nm": measured_nm[pick].round(4), "expected_nm": expected_nm[pick].round(4)}
    return curves


def forecast(
    progress: Progress,
    model_json: str,
    pulse_width_us: list[float],
    pulse_rate_hz: float | None = None,
    angle_rad: list[float] | None = None,
) -> dict[str, Any]:
    """Predict the mean torque in each pulse's period, N·m, effects included, after one second of rest.

    `angle_rad`: of the joint in each pulse's period, where it moves.
    """
    from stimrig.identify.problem.pulses import above_rest

    progress(0.1, "predicting")
    model = identify.Model.from_json(model_json)
    rate_hz = pulse_rate_hz or model.pulse_rate_hz
    angle = None if angle_rad is None else np.asarray(angle_rad, float)
    torque = above_rest(model, np.asarray(pulse_width_us, float), rate_hz, angle)
    return {"pulse_rate_hz": rate_hz, "torque_nm": torque.round(6).tolist()}


def invert(
    progress: Progress,
    model_json: str,
    reference_torque_nm: list[float] | None = None,
    time_s: list[float] | None = None,
    angle_rad: list[float] | None = None,
    table: str | None = None,
    pulse_rate_hz: float | None = None,
    largest_us: float | None = None,
    rise_us: float | None = None,
    whole: bool = True,
    shortest_us: float = 0.0,
) -> dict[str, Any]:
    """Return the pulse widths whose predicted torque follows a reference best, and where it cannot be reached and why.

    The reference comes as numbers, or as the text of a CSV file (`table`).
    """
    from stimrig.identify.inversion import Reference
    from stimrig.identify.inversion import invert as widths_for
    from stimrig.identify.inversion.reference import read_reference

    progress(0.1, "inverting")
    model = identify.Model.from_json(model_json)
    rate_hz = pulse_rate_hz or model.pulse_rate_hz
    if table is not None:
        reference = read_reference(table.encode(), "the upload", rate_hz)
    else:
        reference = Reference.of(reference_torque_nm, time_s, angle_rad=angle_rad, pulse_rate_hz=rate_hz)
    bounds: dict[str, Any] = {"largest_us": largest_us, "rise_us": rise_us, "shortest_us": shortest_us}
    return json_value(widths_for(model, reference, whole=whole, **bounds).to_dict())


def effects(progress: Progress) -> dict[str, Any]:
    from stimrig.identify import effects as library

    progress(0.5, "reading the library")
    return json_value({"effects": library.library()})


def warm(progress: Progress) -> dict[str, Any]:
    """Fit a small made-up record, so that every compiled part is compiled and the fit after a test starts at once."""
    from scipy.signal import lfilter

    progress(0.1, "loading")
    index = np.arange(800)
    time_s = index / 40.0
    switching = 200.0 * (index // 13 % 2)
    width_us = np.select([time_s < 1, time_s < 9], [0.0, switching], np.maximum(0.0, 200 - 40 * abs(time_s - 14)))
    torque_nm = lfilter([0.05 / 40], [1.0, -0.95], width_us) + 0.03 * np.sin(index * index * 0.7)
    segment = np.digitize(time_s, [1, 9])
    names = ["rest", "prbs", "ramp"]
    identify.fit(identify.Record.from_arrays(time_s, width_us, torque_nm, segment, segment_names=names))
    adaptive.warm()
    return {}


VERBS: dict[str, Callable[..., dict[str, Any]]] = {"curves": page_curves, "join": record_files.joined} | {
    verb.__name__: verb
    for verb in (
        fit, carry, comparison, diagnosis, effects, warm, forecast, invert, recorded, record_files.plain_csv,
        record_files.find_recording, record_files.samples, adaptive.adaptive_outlook, adaptive.adaptive_begin,
        adaptive.adaptive_advise, tracking.track, tracking.track_warm,
    )
}  # fmt: skip
