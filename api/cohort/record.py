"""What is computed of a record, in a process that is shut in (`api.workers.child`): a verb's answer as a row's columns.

The columns are those of `--json`, lists in long form. A record may hang the process, fill its memory or crash it: then
it ends, and `api.cohort.computing` makes a row of how.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cohort.select import FIELDS, Selection, as_day
from stimrig.api.cohort.tasks import Task
from stimrig.api.workers import confinement
from stimrig.identify.errors import BadRecord, BadRequest, IdentifyError, NotIdentifiable
from stimrig.identify.json_text import json_value
from stimrig.identify.records import HDF5_MAGIC, bounds
from stimrig.identify.records.hdf5 import StrictFile

REPEATED = {name: field.attribute for name, field in FIELDS.items() if field.attribute}
ABOUT = {**REPEATED, "begun_utc": "created_utc", "recorded_by": "software"}
"""Columns that repeat attributes of a sealed recording, and these."""
SAID = ("day", *REPEATED)
LIBRARIES = (
    "stimrig.identify.fitting", "stimrig.identify.diagnosis", "stimrig.identify.diagnosis.improvement",
    "stimrig.identify.records.csv", "stimrig.identify.records.mat", "stimrig.identify.records.recording",
    "pyarrow.parquet", "pyarrow.compute",
)  # fmt: skip
KINDS: tuple[tuple[type[IdentifyError], str], ...] = (
    (BadRecord, "bad record"), (NotIdentifiable, "not identifiable"), (BadRequest, "bad request"),
)  # fmt: skip
FIGURES = (
    "fit_percent", "ceiling_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm", "held_out_by",
)  # fmt: skip
OF_EFFECT = ("probability", "rms_before_nm", "rms_after_nm", "held_out_rms_before_nm", "held_out_rms_after_nm")
OF_STEP = ("fit_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm")
MODEL = "model"
"""What a parameter belongs to where it is none of an effect's."""
Row = dict[str, Any]


def load() -> None:
    """Load the libraries, so that what they take is not counted as a record's; one process computes, no copies."""
    from stimrig.identify.diagnosis import side_by_side

    for name in LIBRARIES:
        import_module(name)
    side_by_side.WORKERS = 1


def compute(progress: Callable[..., None], file: str, name: str, known: Row, task: Row) -> dict[str, Any]:
    """The row of a record, or `left_out` where the selection does not mean it. Whatever goes wrong is a row.

    `file` is where it lies, `name` what people call it.
    """
    del progress  # nobody waits for one record
    path, row = Path(file), dict(known)
    began_s, processor_s = time.perf_counter(), time.process_time()
    try:
        if not add_answer(path, Task.of(task), row):
            return {"left_out": True}
    except IdentifyError as error:
        kind = next((word for type_, word in KINDS if isinstance(error, type_)), "bad record")
        row |= failed(kind, str(error).replace(file, path.name).replace(path.name, name))
    except MemoryError:
        row |= failed("out of memory", "it takes more memory than a worker may have. Give more with --memory.")
    except RecursionError:
        row |= failed("unexpected", "too deeply nested")
    except Exception as error:
        row |= failed("unexpected", f"{type(error).__name__}: {error}")
    now = confinement.taken()
    row |= {
        "took_s": round(time.perf_counter() - began_s, 4),
        "processor_s": round(time.process_time() - processor_s, 4),
        "worker_memory_mb": now and round(now[1] / 1e6, 1),
    }
    return {"row": json_value(row)}


def add_answer(path: Path, task: Task, row: dict[str, Any]) -> bool:
    """Read, judge and do the verb, into the row; False where the selection does not mean the record."""
    selection = Selection(task.select)
    sealed = describe(path, row)
    if selection(row) is False:
        return False
    record = read(path, () if sealed else task.columns, row)
    row["notes"] = list(record.notes)
    if selection(row) is False:
        return False
    row |= ANSWERS[task.verb](record, task)
    row["status"] = "ok"
    return True


def describe(path: Path, row: Row) -> bool:
    """Whether it is a sealed recording; then what it says of itself, into the row, before all of it is read."""
    with path.open("rb") as start:
        if start.read(len(HDF5_MAGIC)) != HDF5_MAGIC:
            return False
    file = StrictFile(bounds.content_of(path), str(path))
    given: Row = {column: file.text(name, "") for column, name in ABOUT.items()}
    given["day"] = as_day(given["begun_utc"])
    row |= {name: value for name, value in given.items() if value}
    row |= {name: row.get(name) for name in SAID}  # what it does not say is known not to be said
    return True


def read(path: Path, columns: Sequence[str], row: Row) -> Any:
    """The record; what is known once it is read goes into the row. Raises BadRecord."""
    record = identify.read(path, map=list(columns) or None)
    row |= {name: row.get(name) for name in SAID}
    row["duration_s"] = round(float(record.time_s[-1] - record.time_s[0]), 4)
    row["rate_hz"] = round(float(record.sample_rate_hz), 4)
    return record


def failed(kind: str, line: str) -> dict[str, Any]:
    return {"status": "error", "error_kind": kind, "error": " ".join(line.split())[:1000]}


def _fit(record: Any, task: Task) -> Row:
    document = identify.fit(record, method=task.method, effects=task.effects).to_dict()
    fit, quality = document["fit"], document["quality"]
    return {
        **{name: fit.get(name) for name in FIGURES},
        "noise_sd_nm": fit.get("noise_sd_nm"),
        "verdict": quality["verdict"],
        "reasons": list(quality.get("reasons") or []),
        "effects": [_effect(effect) for effect in document["effects"]],
        "parameters": _model_parameters(document),
    }


def _diagnose(record: Any, _task: Task) -> Row:
    from stimrig.identify.diagnosis import planned

    found = identify.diagnose(record).to_dict()
    missing = found["missing"]
    plan = planned(missing, found["deciding_experiment"])
    words = [row["next_experiment"] for row in missing if row["confused_with"]]
    return {
        **{name: found["base"].get(name) for name in FIGURES},
        "noise_sd_nm": found["noise_sd_nm"],
        "verdict": found["verdict"],
        "probability": found["probability"],
        "reasons": list(found["notes"]),
        "effects": [_effect(row) for row in missing],
        "parameters": [one for row in missing for one in _parameters(row["effect"], row["parameters"])],
        "next_experiment": plan.text if plan else next(iter(words), None),
        "next_experiment_s": plan.duration_s if plan else None,
    }  # fmt: skip


def _improve(record: Any, _task: Task) -> Row:
    improved = identify.improve(record)
    found = improved.to_dict()
    steps, document = found["steps"], improved.models[-1].to_dict()
    return {
        **{name: {**document["fit"], **steps[-1]}.get(name) for name in FIGURES},
        "noise_sd_nm": found["noise_sd_nm"],
        "verdict": found["verdict"],
        "reasons": [step["reason"] for step in steps[1:]],
        "effects": [_effect(effect) for effect in document["effects"]],
        "parameters": _model_parameters(document),
        "steps": [{name: step[name] for name in ("added", *OF_STEP)} for step in steps],
        "refused": [{name: row[name] for name in ("effect", "log_evidence_gain")} for row in found["refused"]],
    }  # fmt: skip


ANSWERS = {"fit": _fit, "diagnose": _diagnose, "improve": _improve}


def _effect(found: Mapping[str, Any]) -> Row:
    """An effect of a model, or one that a diagnosis found missing."""
    return {
        "effect": found.get("effect") or found["id"],
        "form": found.get("form"),
        **{name: found.get(name) for name in OF_EFFECT},
        "confused_with": list(found.get("confused_with") or []),
    }


def _model_parameters(document: Mapping[str, Any]) -> list[Row]:
    """Parameters of a MODEL.json: what a person reads off it, and those of its effects."""
    found = _parameters(MODEL, document.get("figures") or document["uncertainty"].get("figures") or {})
    for effect in document["effects"]:
        found += _parameters(effect["id"], effect["parameters"])
    return found


def _parameters(of: str, given: Mapping[str, Any]) -> list[Row]:
    rows = []
    for name, entry in given.items():
        if isinstance(entry.get("value"), int | float):  # a parameter in several values has no figure
            sd = entry.get("sd")
            sd = sd if isinstance(sd, int | float) else None
            rows.append({"of": of, "name": name, "value": entry["value"], "sd": sd, "unit": entry.get("unit") or "1"})
    return rows


VERBS = {"compute": compute}
"""What a process can be asked for (`api.workers.child`)."""
