"""BIDS in: a `…_physio.tsv.gz` or `…_stim.tsv.gz` with its sidecar, and the stim and events files of the same name."""

from __future__ import annotations

import csv
import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.exchange.inward.foreign import Foreign, Signal, Spans, plain
from stimrig.identify.errors import BadRecord
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records import bounds
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES, LARGEST_ROWS, MOST_SEGMENTS
from stimrig.identify.records.cells import as_written

NAME = "BIDS"
OWN_TIMES = "time_s"
KINDS = ("physio", "stim", "motion")
ENDS = tuple(f"_{kind}.tsv.gz" for kind in KINDS)
FIX = "Give the .tsv.gz of a BIDS folder, its .json beside it."


def reads(path: Path, _head: bytes) -> bool:
    """By its name, which BIDS prescribes."""
    return path.name.endswith(ENDS)


def read(path: Path, content: bytes) -> Foreign:
    """What a continuous recording and the files beside it hold. Raises BadRecord."""
    stem = path.name.rpartition("_")[0]
    first, kinds = path.name.removeprefix(f"{stem}_").partition(".")[0], [*KINDS]
    kinds.sort(key=lambda kind: kind != first)
    tables = []
    for kind in kinds:
        place = path.with_name(f"{stem}_{kind}.tsv.gz")
        if kind == first or place.exists():
            head = _head(place)
            text = _unpacked(content if kind == first else bounds.content_of(place), place)
            tables.append((head, _table(text, len(head["Columns"]), place)))
    heads = tables[0][0]
    own_s = [values[:, head["Columns"].index(OWN_TIMES)] for head, values in tables if OWN_TIMES in head["Columns"]]
    signals = [signal for head, values in tables for signal in _signals(head, values, own_s)]
    events = path.with_name(f"{stem}_events.tsv")
    rows = _rows(events) if events.exists() else []
    named: dict[str, int] = {}
    signals = [one for one in signals if not (one.name in named or named.update({one.name: 1}))]
    about = {"recording_id": heads.get("RecordingID"), "participant": _subject(path)}
    spans = _spans(rows)
    own = _own(heads, signals, spans)
    return Foreign(NAME, tuple(signals), () if spans is None else (spans,), own, {k: v for k, v in about.items() if v})


def _head(place: Path) -> dict[str, Any]:
    sidecar = place.with_name(place.name.removesuffix(".tsv.gz") + ".json")
    try:
        head = parse(bounds.content_of(sidecar))
        rate_hz, start_s, names = float(head["SamplingFrequency"]), float(head["StartTime"]), list(head["Columns"])
    except (BadJson, KeyError, TypeError, ValueError):
        message = "no SamplingFrequency, StartTime and Columns"
        raise BadRecord(message, place=str(sidecar), fix=FIX) from None
    if not (0 < rate_hz < 1e6 and abs(start_s) < 1e10 and 0 < len(names) < 500):
        raise BadRecord("a rate, a start or columns that no recording has", place=str(sidecar), fix=FIX)
    return head


def _signals(head: dict[str, Any], values: np.ndarray, own_s: list[np.ndarray]) -> list[Signal]:
    """The columns at their times: of the even grid, or those that ours has where the grid does not give them back."""
    columns = dict(zip([str(name) for name in head["Columns"]], values.T, strict=True))
    time_s = float(head["StartTime"]) + np.arange(len(values)) / float(head["SamplingFrequency"])
    time_s = next((times for times in own_s if times.size == time_s.size), time_s)
    lost = np.isnan(time_s) | np.isnan(values).all(1)
    said = {name: head[name] if isinstance(head.get(name), dict) else {} for name in columns}
    return [
        Signal(name, time_s[~lost], column[~lost], plain(str(said[name].get("Units") or "")))
        for name, column in columns.items()
        if name != OWN_TIMES
    ]


def _unpacked(content: bytes, place: Path) -> bytes:
    packer = zlib.decompressobj(31)
    try:
        found = packer.decompress(content, LARGEST_FILE_BYTES)
    except zlib.error:
        raise BadRecord("packed data that do not unpack", place=str(place), fix=FIX) from None
    if not packer.eof:
        message = f"it ends in the middle, or holds more than {LARGEST_FILE_BYTES // 2**20} MB"
        raise BadRecord(message, place=str(place), fix=FIX)
    return found


def _table(text: bytes, width: int, place: Path) -> np.ndarray:
    """Rows of numbers, NaN for n/a. Raises BadRecord: something else, or rows of another length."""
    lines = text.decode("utf-8", "replace").splitlines()
    if not 0 < len(lines) <= LARGEST_ROWS // width:
        raise BadRecord(f"{len(lines)} rows", place=str(place), fix=f"At most {LARGEST_ROWS} numbers are read.")
    found = np.empty((len(lines), width))
    for index, line in enumerate(lines):
        cells = ["nan" if cell == "n/a" else cell for cell in line.split("\t")]
        try:
            found[index] = [float(cell) for cell in cells] if len(cells) == width else [float("x")]
        except ValueError:
            message = f"not {width} numbers with tabs between them"
            raise BadRecord(message, place=f"{place}, line {index + 1}", fix=FIX) from None
    return found


def _rows(place: Path) -> list[dict[str, str]]:
    text = bounds.content_of(place).decode("utf-8", "replace")
    return list(csv.DictReader(io.StringIO(text), delimiter="\t"))


def _spans(rows: list[dict[str, str]]) -> Spans | None:
    """Events that last. Ours say their name in `segment`, others in `trial_type`."""
    found = []
    for row in rows:
        try:
            onset_s, duration_s = float(row["onset"]), float(row["duration"])
        except (KeyError, ValueError, TypeError):
            continue
        ours = row.get("trial_type") == "segment"
        name = as_written(row.get("segment" if ours else "trial_type") or "")
        if duration_s > 0 and name not in ("", "n/a"):
            found.append((name, onset_s, onset_s + duration_s))
    return Spans("events", tuple(found)) if 0 < len(found) <= MOST_SEGMENTS else None


def _subject(path: Path) -> str:
    return next((part.removeprefix("sub-") for part in path.name.split("_") if part.startswith("sub-")), "")


def _own(head: dict[str, Any], signals: list[Signal], spans: Spans | None) -> dict[str, str]:
    """The answers, where our export wrote the folder: by its columns' names, which are ours."""
    there = {one.name: one.unit for one in signals}
    if not {"torque_nm", "pulse_width_us"} <= there.keys() or "RecordingID" not in head or "PulseRate" not in head:
        return {}
    own = {name: f"{name}:{unit}" if unit else name for name, unit in there.items() if name != "sync"}
    return {
        **own,
        "sign": "+1",
        "segments": "events" if spans else "none",
        "pulse-rate-hz": repr(float(head["PulseRate"])),
    }
