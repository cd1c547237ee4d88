"""FHIR R4 and R5 in: the SampledData of the observations in a bundle, or of one observation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.exchange.inward.foreign import Foreign, Signal, Spans, plain
from stimrig.api.exchange.outward.fhir import SYSTEM
from stimrig.identify.errors import BadRecord
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records.bounds import LARGEST_ROWS

NAME = "FHIR"
OWN = {"torque_nm": "torque_nm:Nm", "pulse_width_us": "pulse_width_us:us", "segments": "segments", "sign": "+1"}
INTERVALS_MS = {"ms": 1.0, "s": 1000.0, "us": 1e-3}


def reads(_path: Path, head: bytes) -> bool:
    """Whether it is JSON that says what resource it is near its beginning."""
    return head.lstrip()[:1] == b"{" and b'"resourceType"' in head


def read(path: Path, content: bytes) -> Foreign:
    """What a bundle's observations hold. Raises BadRecord."""
    try:
        document = parse(content)
    except BadJson as error:
        raise BadRecord(f"no JSON ({error})", place=str(path), fix="Give the whole file.") from None
    entries = document.get("entry") or []
    resources = (
        [one.get("resource") or {} for one in entries] if document.get("resourceType") == "Bundle" else [document]
    )
    found = [one for one in resources if one.get("resourceType") == "Observation"]
    if len(found) != 1:
        message = f"{len(found)} observations in it"
        raise BadRecord(message, place=str(path), fix="Give a file for each observation with SampledData.")
    parts = [found[0], *(found[0].get("component") or [])]
    signals = _columns(parts, path)
    spans = Spans("segments", tuple(_segments(parts)))
    numbers = {code: value["value"] for code, value in _values(parts, "valueQuantity")}
    about = {_kind(one): one.get("value") for one in found[0].get("identifier") or []}
    told = {"recording_id": about.get("recording"), "participant": _participant(resources)}
    own: dict[str, str] = {}
    if {"torque_nm", "pulse_width_us"} <= {one.name for one in signals} and "pulse_rate_hz" in numbers:
        own = {**OWN, "pulse-rate-hz": repr(float(numbers["pulse_rate_hz"]))}
        own |= {} if spans.rows else {"segments": "none"}
    return Foreign(NAME, tuple(signals), (spans,) if spans.rows else (), own, {k: v for k, v in told.items() if v})


def _code(part: dict[str, Any]) -> str:
    """Our own code, else the text, else any code."""
    code = part.get("code") or {}
    codings = code.get("coding") or []
    ours = [one.get("code") for one in codings if one.get("system") == f"{SYSTEM}:code"]
    return str(next((one for one in (*ours, code.get("text"), *(one.get("code") for one in codings)) if one), "value"))


def _values(parts: list[dict[str, Any]], kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for part in parts:
        if isinstance(part.get(kind), dict):
            yield _code(part), part[kind]


def _columns(parts: list[dict[str, Any]], path: Path) -> list[Signal]:
    """Columns with their times; a component that goes on with a code before it is the same column."""
    blocks: dict[str, list[dict[str, Any]]] = {}
    for code, sampled in _values(parts, "valueSampledData"):
        blocks.setdefault(code, []).append(sampled)
    start_s = next((float(value["value"]) for code, value in _values(parts, "valueQuantity") if code == "start_s"), 0.0)
    columns = {
        code: np.concatenate([_numbers(one, f"{path}, {code}") for one in those]) for code, those in blocks.items()
    }
    own_s = columns.pop("time_s", None)
    found = []
    for code, values in columns.items():
        first = blocks[code][0]
        step_ms = float(first.get("period") or first.get("interval") or 0) * INTERVALS_MS.get(
            str(first.get("intervalUnit") or "ms"), float("nan"))  # fmt: skip
        if not step_ms > 0 or int(first.get("dimensions") or 1) != 1 or first.get("offsets"):
            message = "SampledData of several dimensions, or without an even interval in s, ms or us"
            raise BadRecord(message, place=f"{path}, {code}", fix="Give one dimension with its period.")
        grid_s = start_s + np.arange(values.size) * step_ms / 1000
        time_s = own_s if own_s is not None and own_s.size == values.size else grid_s
        there = np.isfinite(time_s) & np.isfinite(columns.get("torque_nm", values))[: values.size]
        unit = plain(str((first.get("origin") or {}).get("code") or (first.get("origin") or {}).get("unit") or ""))
        found.append(Signal(code, time_s[there], values[there], unit))
    return found


def _numbers(sampled: dict[str, Any], place: str) -> np.ndarray:
    texts = str(sampled.get("data") or "").split(" ")
    if len(texts) > LARGEST_ROWS:
        raise BadRecord(f"{len(texts)} numbers", place=place, fix=f"At most {LARGEST_ROWS} are read.")
    try:
        values = np.array([float("nan") if text in ("E", "U", "L") else float(text) for text in texts])
        origin, factor = float((sampled.get("origin") or {}).get("value") or 0), float(sampled.get("factor") or 1)
    except ValueError:
        raise BadRecord(
            "data that are no decimal numbers", place=place, fix="Give SampledData as FHIR has it."
        ) from None
    return values if (origin, factor) == (0.0, 1.0) else values * factor + origin


def _segments(parts: list[dict[str, Any]]) -> Iterator[tuple[str, float, float]]:
    for part in parts:
        span = part.get("valueRange")
        if isinstance(span, dict) and _code(part) == "segment":
            yield str(part["code"].get("text")), float(span["low"]["value"]), float(span["high"]["value"])


def _kind(identifier: dict[str, Any]) -> str:
    return str(identifier.get("system") or "").rpartition(":")[2]


def _participant(resources: list[dict[str, Any]]) -> str | None:
    people = [one for one in resources if one.get("resourceType") == "Patient"]
    return next(
        (str(one["value"]) for person in people for one in person.get("identifier") or [] if "value" in one), None
    )
