"""The verbs on recordings and models of several muscles at one joint: each is taken where what is given is of them."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.effect_words import effect_words
from stimrig.api.record_files import Progress
from stimrig.api.workers.curves import POINTS, rounded, runs, step_response
from stimrig.identify import muscles
from stimrig.identify.criticism import worst_places
from stimrig.identify.json_text import json_value, parse
from stimrig.identify.muscles import verbs as joint

Verb = Callable[..., dict[str, Any]]
OF_THE_JOINT = re.compile(r"^joint\.")
"""Before an effect that is of the joint, as a search names it; it is kept with the first channel."""


def routed(name: str, one: Verb) -> Verb:
    """A verb that does the same of one muscle and of several."""
    several = OF_SEVERAL.get(name)
    if several is None:
        return one

    @functools.wraps(one)
    def either(**given: Any) -> dict[str, Any]:
        return (several if is_joint(given) else one)(**given)

    return either


def is_joint(given: dict[str, Any]) -> bool:
    """Whether a call is about several muscles; what cannot be read is left to the usual verb, which says so."""
    with contextlib.suppress(identify.IdentifyError, OSError, ValueError):
        if model_json := given.get("model_json"):
            return '"kind"' in model_json and muscles.is_joint_model(parse(model_json))
        return muscles.is_joint(given["data"])
    return False


def fit(data: str, progress: Progress, effects: Sequence[str] = (), **_of_one: Any) -> dict[str, Any]:
    """As `verbs.fit`; effects that name no channel are of one muscle's structure, and are left out."""
    progress(0.05, "reading the recording")
    record = muscles.read(Path(data))
    own, between, _of_one_muscle = joint.parted(effects, record.names)
    model = muscles.fit(record, own, between, lambda share, text="": progress(0.1 + 0.9 * share, text))
    first = record.records[0]
    told = {"json": model.to_json(), "model": model.to_dict()}
    return {**told, "notes": model.data["notes"], "of": first.source.participant}


def comparison(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """As `curves.comparison`, and the error on held-out pulses of each muscle alone and of both."""
    progress(0.1, "comparing")
    record, model = muscles.read(Path(data)), muscles.JointModel.from_json(model_json)
    predicted = muscles.predict(model, record)
    found, residual = joint.errors_of(record, predicted), record.torque_nm - predicted
    noise_nm, pick = found["noise_sd_nm"], _pick(record)
    where = worst_places(record.records[0], residual, noise_nm, rows=record.grids[0].counted)
    series = {"time_s": record.time_s[pick], "residual_nm": residual[pick], "noise_band_nm": 2.0 * noise_nm}
    held_out = {"rms_nm": found.get("held_out_rms_nm")}
    return rounded(json_value({**found, "held_out": held_out, "where": where, "series": series, "plain": []}))


def curves(data: str, progress: Progress, model_json: str) -> dict[str, Any]:
    """As `curves.page_curves`; of each muscle also its share of the torque, its pulse widths, its step response."""
    progress(0.1, "predicting")
    record, model = muscles.read(Path(data)), muscles.JointModel.from_json(model_json)
    pick, (predicted, parts) = _pick(record), muscles.whole_and_parts(model, record)
    own = {
        name: {
            "torque_nm": parts[name][pick].round(5),
            "pulse_width_us": one.pulse_width_us[pick].round(2),
            "step_response": step_response(model.of(name).to_dict()),
        }
        for name, one in zip(record.names, record.records, strict=True)
    }
    first, labels = record.records[0], [record.records[0].segment_names[index] for index in record.records[0].segment]
    return json_value({
        "time_s": record.time_s[pick].round(5), "torque_nm": record.torque_nm[pick].round(5),
        "predicted_torque_nm": predicted[pick].round(5),
        "pulse_width_us": first.pulse_width_us[pick].round(2), "segments": runs(labels, record.time_s),
        "step_response": own[record.names[0]]["step_response"], "muscles": own,
    })  # fmt: skip


def _pick(record: Any) -> slice:
    return slice(None, None, max(1, -(-record.time_s.size // POINTS)))


def diagnosis(data: str, progress: Progress, model_json: str | None = None, **_of_one: Any) -> dict[str, Any]:
    """As `verbs.diagnosis`, with the improvement that was found by the way."""
    record = muscles.read(Path(data))
    structure: list[str] = []
    model = None if model_json is None else muscles.JointModel.from_json(model_json)
    if model is not None:
        own, structure = joint.structure_of(model)
        structure += [f"{name}.{effect}" for name, effects in own.items() for effect in effects]
    searched = joint.searched(record, model, progress)
    found, improved = joint.diagnosis_of(searched).to_dict(), joint.improvement_of(searched).to_dict()
    first = f"{record.names[0]}."
    for row in [*found["missing"], *found["candidates"]]:
        row["effect"] = OF_THE_JOINT.sub(first, row["effect"])
        row["name"] = effect_words(row["effect"])  # as pages say it, and translate it
    for step in improved["steps"]:
        step["added"] = step["added"] and OF_THE_JOINT.sub(first, step["added"])
    told = {
        row["effect"]: {"name": row["name"], "plain": row.get("plain", "")}
        for row in (*found["missing"], *found["candidates"])
    }
    empty = {"where": [], "free": [], "experiment": None, "deciding_experiment": None, "signatures": {}}
    kept = {**found, **empty, "candidates": [found["candidates"]], "structure": structure, "library": told}
    for row in kept["missing"]:
        row.setdefault("parameters", {})
    return json_value({**kept, "improvement": {**improved, "structure": structure}})


def export_csv(data: str, progress: Progress, out: str) -> dict[str, Any]:
    """As `record_files.export_csv`, with a column of pulse widths for each channel."""
    from stimrig.api.record_files import write_table

    progress(0.1, "reading the recording")
    record = muscles.read(Path(data))
    widths = {
        f"{name}_pulse_width_us": muscles.held_later(record.time_s, one.pulse_width_us, channel.offset_s)
        for name, one, channel in zip(record.names, record.records, record.channels, strict=True)
    }
    progress(0.7, "writing")
    return write_table(record.records[0], {**widths, "torque_nm": record.torque_nm}, Path(out))


OF_SEVERAL: dict[str, Verb] = {
    verb.__name__: verb for verb in (fit, comparison, curves, diagnosis, export_csv)
}  # fmt: skip
