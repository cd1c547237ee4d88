"""FHIR R4 and R5: a bundle a record in each: torque as SampledData of an Observation, devices, a DiagnosticReport.

The resources are written as JSON. A participant is a code in `identifier`, and nothing else. What R4 and R5 differ in
stands in `Release`; R4B defines these resources as R4 does. A text of FHIR has at most 2^20 signs: a long column goes
on in the next component of the same code.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from stimrig.api.cohort.export import Put, Who
from stimrig.api.cohort.export_state import State
from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.exchange.outward import _figures
from stimrig.api.exchange.outward.bids import grid
from stimrig.api.exchange.outward.parquet import record_row

NAME: str = "fhir"
SYSTEM = "urn:stimrig"
UCUM = "http://unitsofmeasure.org"
BLOCK = 40_000
"""Numbers of one SampledData: at most 25 signs each."""
COLUMNS = {"torque_nm": ("N.m", "torque"), "pulse_width_us": ("us", "pulse width in force, held between pulses"),
           "time_s": ("s", "time of each sample, where they are not even")}  # fmt: skip
SPACE = uuid.UUID("6f1e6bb0-4e0c-5b0a-9d3d-0d5a3c6f5b11")


@dataclass(frozen=True)
class Release:
    """A release of FHIR, and how it writes what the other writes in another way."""

    name: str

    def sampled(self, period_ms: float) -> dict[str, Any]:
        """The time between two samples."""
        return {"period": period_ms} if self.name == "r4" else {"interval": period_ms, "intervalUnit": "ms"}

    def device(self, name: str, version: str) -> dict[str, Any]:
        """What a device is called."""
        if self.name == "r4":
            named = {"deviceName": [{"name": name, "type": "user-friendly-name"}], "type": {"text": name}}
        else:
            named = {"name": [{"value": name, "type": "user-friendly-name"}], "type": [{"text": name}]}
        return {**named, ("version" if name == "software" else "note"): [
            {"value": version} if name == "software" else {"text": f"device: {version}"}]}  # fmt: skip


RELEASES = (Release("r4"), Release("r5"))


def write(record: WholeRecord, who: Who, put: Put) -> dict[str, Any]:
    """The record's bundles; its row."""
    found = _figures.fitted(record)
    for release in RELEASES:
        bundle = {"resourceType": "Bundle", "type": "collection", "entry": list(_entries(record, who, found, release))}
        with put(f"{release.name}/sub-{who.label}/ses-{who.session}/{who.key}.json") as file:
            file.write((json.dumps(bundle, ensure_ascii=False, allow_nan=False) + "\n").encode())
    return record_row(record, who)


def finish(_state: State, _put: Put) -> None:
    """Nothing is made of all files."""


def _entries(record: WholeRecord, who: Who, found: dict[str, Any], release: Release) -> Iterator[dict[str, Any]]:
    def entry(kind: str, of: str, content: dict[str, Any]) -> dict[str, Any]:
        return {"fullUrl": url(kind, of), "resource": {"resourceType": kind, **content}}

    def url(kind: str, of: str) -> str:
        return f"urn:uuid:{uuid.uuid5(SPACE, f'{kind} {of}')}"

    person, whose = url("Patient", who.participant), {"reference": url("Patient", who.participant)}
    yield {"fullUrl": person, "resource": {
        "resourceType": "Patient", "identifier": [_identifier("participant", who.participant)]}}  # fmt: skip
    for name, version in _figures.devices(record).items():
        yield entry("Device", f"{who.key} {name}", release.device(name, version))
    when = {"effectiveDateTime": who.begun_utc} if who.begun_utc else {}
    measured = url("Observation", who.key)
    yield entry("Observation", who.key, {
        "identifier": [_identifier("recording", who.record_id), _identifier("sha256", record.sha256)],
        "status": "final", "code": _code("recording", "torque at a joint under electrical stimulation"),
        "subject": whose, **when, "device": {"reference": url("Device", f"{who.key} load cell")},
        "component": [*_sampled(record, release), *_segments(record), *_quantities(record, found)],
    })  # fmt: skip
    verdict = found["verdict"]
    yield entry("DiagnosticReport", who.key, {
        "identifier": [_identifier("recording", who.record_id)],
        "status": "preliminary",  # no person has looked at it
        "code": _code("plain-model", "plain model of the muscle, fitted at export"), "subject": whose, **when,
        "result": [{"reference": measured}], "conclusion": f"Plain model: {verdict}. No diagnosis of a disease.",
    })  # fmt: skip


def _identifier(kind: str, value: str) -> dict[str, Any]:
    return {"system": f"{SYSTEM}:{kind}", "value": value}


def _code(code: str, text: str) -> dict[str, Any]:
    return {"coding": [{"system": f"{SYSTEM}:code", "code": code}], "text": text}


def quantity(value: float, ucum: str) -> dict[str, Any]:
    """A number with its UCUM unit."""
    return {"value": value, "unit": ucum, "system": UCUM, "code": ucum}


def _sampled(record: WholeRecord, release: Release) -> Iterator[dict[str, Any]]:
    """The columns on an even grid, E where a sample was lost; with each time where the grid does not give it back."""
    rate_hz, start_s, at, exact = grid(record)
    yield {"code": _code("start_s", "time of the first sample, on the test's clock"),
           "valueQuantity": quantity(start_s, "s")}  # fmt: skip
    for name, (ucum, says) in COLUMNS.items():
        if name == "time_s" and exact:
            continue
        texts = np.full(int(at[-1]) + 1, "E", object)
        texts[at] = [_decimal(value) for value in record.samples[name].tolist()]
        for first in range(0, len(texts), BLOCK):
            yield {"code": _code(name, says), "valueSampledData": {
                "origin": quantity(0, ucum), **release.sampled(1000 / rate_hz), "dimensions": 1,
                "data": " ".join(texts[first : first + BLOCK])}}  # fmt: skip


def _decimal(value: float) -> str:
    """A number as SampledData takes it, without exponent, as short as it reads back unchanged."""
    return np.format_float_positional(value, trim="-") if np.isfinite(value) else "E"


def _segments(record: WholeRecord) -> Iterator[dict[str, Any]]:
    for name, start_s, end_s in record.segments:
        yield {"code": _code("segment", name),
               "valueRange": {"low": quantity(start_s, "s"), "high": quantity(end_s, "s")}}  # fmt: skip


def _quantities(record: WholeRecord, found: dict[str, Any]) -> Iterator[dict[str, Any]]:
    rate_hz = record.about.get("pulse_rate_hz")
    numbers = {"pulse_rate_hz": (rate_hz, "Hz", "pulses a second")}
    numbers |= {one.name: (found.get(one.name), one.ucum, one.says) for one in _figures.FIGURES}
    for name, (value, ucum, says) in numbers.items():
        if value is not None:
            yield {"code": _code(name, says), "valueQuantity": quantity(value, ucum)}
