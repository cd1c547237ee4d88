"""One record's row, computed in a process of its own (`stimrig.api.cohort.worker`).

The columns are those of `--json`, lists in long form.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cohort.select import FIELDS, Selection, parse_day
from stimrig.api.cohort.task import Task
from stimrig.identify.errors import BadRequest, IdentifyError, NotIdentifiable
from stimrig.identify.json_text import json_value
from stimrig.identify.records import HDF5_MAGIC, bounds
from stimrig.identify.records.hdf5 import StrictFile

REPEATED = {name: field.attribute for name, field in FIELDS.items() if field.attribute}
"""Columns that repeat attributes of a sealed recording."""
LEFT_OUT = "left out"
"""Status of a record that is not selected; it gets no row."""
FIGURES = (
    "fit_percent", "ceiling_percent", "rms_nm", "held_out_fit_percent", "held_out_rms_nm", "held_out_by",
)  # fmt: skip
Row = dict[str, Any]


def compute_row(file: Path, name: str, known: Mapping[str, Any], task: Task) -> Row:
    """Return the row of a record; whatever goes wrong is its error. As `read_row`."""
    began_s, processor_s = time.perf_counter(), time.process_time()
    selection, verb = Selection(task.select), ANSWERS[task.verb]
    row = read_row(file, name, known, selection, task.columns, lambda record: json_value(verb(record, task)))
    if row["status"] == LEFT_OUT:
        return row
    return row | {
        "begun_utc": _parse_utc(row.get("begun_utc") or ""),
        "took_s": round(time.perf_counter() - began_s, 4),
        "processor_s": round(time.process_time() - processor_s, 4),
        "worker_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000, 1),
    }


def read_row(
    file: Path, name: str, known: Mapping[str, Any], selection: Selection, columns: Sequence[str],
    answer: Callable[[Any], Row],
) -> Row:  # fmt: skip
    """Read a record and return its row with what it answers; its status is `ok`, `error` or `left out`.

    `file`: where it lies, `name`: as its error names it; `known`: fields of its listing; `columns`: of other tools'
    tables, as --map gives them. Whatever a record of somebody else's does, the others go on. Raises OSError.
    """
    row = dict(known)
    try:
        record = read_selected(file, row, selection, columns)
        if record is None:
            return {"status": LEFT_OUT}
        return row | {"notes": list(record.notes), "status": "ok", **answer(record)}
    except IdentifyError as error:
        kinds = {NotIdentifiable: "not identifiable", BadRequest: "bad request"}
        kind = next((word for type_, word in kinds.items() if isinstance(error, type_)), "bad record")
        return row | failed(kind, str(error).replace(str(file), file.name).replace(file.name, name))
    except MemoryError:
        return row | failed("out of memory", "it takes more memory than there is. Give more with --memory, or cut it.")
    except RecursionError:
        return row | failed("unexpected", "too deeply nested")
    except OSError:
        raise
    except Exception as error:
        return row | failed("unexpected", f"{type(error).__name__}: {error}")


def read_selected(path: Path, row: Row, selection: Selection, columns: Sequence[str]) -> Any:
    """Read a record, and write into `row` what it says of itself; None if it is not selected. Raises IdentifyError."""
    with path.open("rb") as start:
        sealed = start.read(len(HDF5_MAGIC)) == HDF5_MAGIC
    if sealed:  # what it says of itself is read before all of it is
        file = StrictFile(bounds.content_of(path), str(path))
        begun_utc = file.text("created_utc", "")
        row |= {"begun_utc": begun_utc or None, "day": parse_day(begun_utc)}
        row["recorded_by"] = file.text("software", "") or None
        row |= {name: file.text(attribute, "") or None for name, attribute in REPEATED.items()}
        if selection(row) is False:
            return None
    record = identify.read(path, map=None if sealed else list(columns) or None)
    row |= {name: row.get(name) for name in ("day", *REPEATED)}  # what it does not say is known not to be said
    row["duration_s"] = round(float(record.time_s[-1] - record.time_s[0]), 4)
    row["rate_hz"] = round(float(record.sample_rate_hz), 4)
    return None if selection(row) is False else record


def _parse_utc(text: str) -> datetime | None:
    try:
        time_utc = datetime.fromisoformat(text)
        return (time_utc if time_utc.tzinfo else time_utc.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def failed(kind: str, line: str) -> Row:
    """Return the columns of a record without a result."""
    line = " ".join(line.split())[:1000].encode("utf-8", "replace").decode()
    return {"status": "error", "error_kind": kind, "error": line}


def _fit(record: Any, task: Task) -> Row:
    document = identify.fit(record, method=task.method, effects=task.effects).to_dict()
    quality = document["quality"]
    about = {"verdict": quality["verdict"], "reasons": quality.get("reasons") or []}
    return _model(document, document["fit"]) | about


def _diagnose(record: Any, _task: Task) -> Row:
    from stimrig.identify.diagnosis import planned

    answer = identify.diagnose(record).to_dict()
    missing = answer["missing"]
    plan = planned(missing, answer["deciding_experiment"])
    experiments = [row["next_experiment"] for row in missing if row["confused_with"]]
    return {
        **{name: answer["base"].get(name) for name in FIGURES},
        "noise_sd_nm": answer["noise_sd_nm"],
        "verdict": answer["verdict"],
        "probability": answer["probability"],
        "reasons": answer["notes"],
        "effects": [_effect(row) for row in missing],
        "parameters": [entry for row in missing for entry in _parameters(row["effect"], row["parameters"])],
        "next_experiment": plan.text if plan else next(iter(experiments), None),
        "next_experiment_s": plan.duration_s if plan else None,
    }


def _improve(record: Any, _task: Task) -> Row:
    improved = identify.improve(record)
    answer, document = improved.to_dict(), improved.models[-1].to_dict()
    about = {name: answer[name] for name in ("noise_sd_nm", "verdict", "steps", "refused")}
    reasons = [step["reason"] for step in answer["steps"][1:]]
    return _model(document, {**document["fit"], **answer["steps"][-1]}) | about | {"reasons": reasons}


ANSWERS = {"fit": _fit, "diagnose": _diagnose, "improve": _improve}


def _effect(effect: Mapping[str, Any]) -> Row:
    """Return the row of an effect of a model, or of one that a diagnosis found missing."""
    name = effect.get("effect") or effect["id"]
    return {**effect, "effect": name, "confused_with": effect.get("confused_with") or []}


def _model(document: Mapping[str, Any], figures: Mapping[str, Any]) -> Row:
    """Return the columns of a MODEL.json: figures, effects, parameters of itself and of its effects."""
    parameters = _parameters("model", document.get("figures") or document["uncertainty"].get("figures") or {})
    for effect in document["effects"]:
        parameters += _parameters(effect["id"], effect["parameters"])
    effects = [_effect(effect) for effect in document["effects"]]
    figures = {name: figures.get(name) for name in (*FIGURES, "noise_sd_nm")}
    return {**figures, "effects": effects, "parameters": parameters}


def _parameters(of: str, parameters: Mapping[str, Any]) -> list[Row]:
    def number(value: Any) -> Any:
        return value if isinstance(value, int | float) else None

    return [
        {
            "of": of,
            "name": name,
            "value": entry["value"],
            "sd": number(entry.get("sd")),
            "unit": entry.get("unit") or "1",
        }
        for name, entry in parameters.items()
        if number(entry.get("value")) is not None  # a parameter in several values has no figure
    ]
