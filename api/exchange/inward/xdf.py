"""XDF of LabRecorder in: streams on one clock by their own measurements, none made even, with what was lost told.

Each chunk is looked at before the library takes memory for what it declares. Streams of one host have one clock; where
the clocks of two were not measured against each other, the offset is asked for.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.exchange.inward.foreign import Foreign, Signal, Spans, plain
from stimrig.identify.errors import BadRecord
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records.bounds import LARGEST_ROWS, MOST_SEGMENTS

NAME = "XDF"
MAGIC = b"XDF:"
HEADER, SAMPLES, STREAM_FOOTER = 2, 3, 6
FIX = "Give the whole file, as LabRecorder wrote it."
MOST_CHANNELS = 256


def reads(_path: Path, head: bytes) -> bool:
    """By its first bytes."""
    return head.startswith(MAGIC)


def read(path: Path, content: bytes) -> Foreign:
    """What the streams hold. Raises BadRecord."""
    import pyxdf

    whole = _check_chunks(content, str(path))
    streams, _ = pyxdf.load_xdf(io.BytesIO(content), dejitter_timestamps=False, handle_clock_resets=True, verbose=False)
    told = [] if whole else ["the file ends in the middle of a chunk: what stands before it was read"]
    signals, spans, marks = [], [], []
    for stream in streams:
        info = stream["info"]
        name, text = info["name"][0] or "stream", info["channel_format"][0] == "string"
        clock = "" if len(stream.get("clock_times", ())) else str(info["hostname"][0] or name)
        if not clock:
            told.append(f"{name}: brought to the recorder's clock by {len(stream['clock_times'])} measurements")
        told += _lost(stream, name)
        if text:
            made, more, events = _marks(stream, name, clock)
            marks += events
            signals += made
            spans += more
        else:
            signals += _columns(stream, name, clock)
    found, own, about = _own(signals, marks, told)
    return Foreign(NAME, tuple(found), tuple(spans), own, about, tuple(told))


def _check_chunks(content: bytes, place: str) -> bool:
    """Whether the file is whole. Raises BadRecord: a chunk declares more than it holds, or an unsound header."""
    at, channels = len(MAGIC), {}
    while at < len(content):
        width = content[at]
        if width not in (1, 4, 8):
            raise BadRecord("a chunk without a length", place=f"{place}, byte {at}", fix=FIX)
        length = int.from_bytes(content[at + 1 : at + 1 + width], "little")
        begin = at + 1 + width
        at = begin + length
        if at > len(content) or length < 2:
            return False
        tag, body = int.from_bytes(content[begin : begin + 2], "little"), content[begin + 2 : at]
        if tag in (1, HEADER, STREAM_FOOTER) and (b"<!DOCTYPE" in body or b"<!ENTITY" in body):
            raise BadRecord("a header with declarations of its own", place=place, fix=FIX)
        if tag == SAMPLES:
            size = body[4] if len(body) > 4 else 0
            count = int.from_bytes(body[5 : 5 + size], "little")
            if size not in (1, 4, 8) or count > len(body) or count > LARGEST_ROWS:
                raise BadRecord(f"{count} samples in a chunk of {len(body)} bytes", place=place, fix=FIX)
        if tag == HEADER:
            channels[body[:4]] = _count(body)
            if not 0 < channels[body[:4]] <= MOST_CHANNELS:
                raise BadRecord(f"{channels[body[:4]]} channels in a stream", place=place, fix=FIX)
    return True


def _count(body: bytes) -> int:
    found = body.partition(b"<channel_count>")[2].partition(b"</channel_count>")[0]
    return int(found) if found.strip().isdigit() else 0


def _lost(stream: dict[str, Any], name: str) -> Iterator[str]:
    """What of a stream with a rate is missing, and the rate that it had."""
    time_s, nominal_hz = stream["time_stamps"], float(stream["info"]["nominal_srate"][0] or 0)
    if nominal_hz > 0 and len(time_s) > 2:
        steps = np.diff(time_s)
        step_s = float(np.median(steps))
        lost = int(np.sum(np.round(steps[steps > 1.5 * step_s] / step_s) - 1)) if step_s > 0 else 0
        rate_hz = 1 / step_s if step_s > 0 else 0
        yield f"{name}: {nominal_hz:g} Hz said, {rate_hz:.6g} Hz found, {lost} samples lost"


def _channels(stream: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and unit of each channel, as the description says them."""
    count = int(stream["info"]["channel_count"][0])
    try:
        listed = stream["info"]["desc"][0]["channels"][0]["channel"]
        found = [((one.get("label") or [""])[0] or "", (one.get("unit") or [""])[0] or "") for one in listed]
    except (KeyError, IndexError, TypeError, AttributeError):
        found = []
    found += [("", "")] * (count - len(found))
    return [(label or str(index + 1), plain(unit)) for index, (label, unit) in enumerate(found[:count])]


def _columns(stream: dict[str, Any], name: str, clock: str) -> Iterator[Signal]:
    values, time_s = np.asarray(stream["time_series"], float), np.asarray(stream["time_stamps"], float)
    events = float(stream["info"]["nominal_srate"][0] or 0) == 0
    if values.ndim != 2 or not time_s.size:
        return
    labels = _channels(stream)
    for index, (label, unit) in enumerate(labels):
        called = name if len(labels) == 1 else f"{name}/{label}"
        yield Signal(called, time_s, values[:, index], unit, events, clock)


def _marks(stream: dict[str, Any], name: str, clock: str) -> tuple[list[Signal], list[Spans], list[Any]]:
    """Marks as times of something, as spans from each to the next, and as they are."""
    time_s = np.asarray(stream["time_stamps"], float)
    texts = [str(row[0]) for row in stream["time_series"]]
    if not texts:
        return [], [], []
    ends = [*time_s[1:].tolist(), float("inf")]
    rows = tuple(zip(texts, time_s.tolist(), ends, strict=True))
    spans = [Spans(name, rows, clock)] if len(set(texts)) > 1 and len(texts) <= MOST_SEGMENTS else []
    signals = [] if any(text.startswith("{") for text in texts) else [
        Signal(name, time_s, np.full(time_s.size, np.nan), "", True, clock)]  # fmt: skip
    return signals, spans, list(zip(time_s.tolist(), texts, strict=True))


def _own(
    signals: list[Signal], marks: list[tuple[float, str]], told: list[str]
) -> tuple[list[Signal], dict[str, str], dict[str, Any]]:
    """The answers, where the streams are ours (docs/lsl.md), and the signals cut to the one test by its marks."""
    names = {one.name for one in signals}
    torque = next((name for name in names if name.endswith("-torque") or name == "torque"), "")
    width = f"{torque.removesuffix('-torque')}-pulses/pulse_width"
    starts, ends = [], []
    for time_s, text in marks:
        try:
            mark = parse(text)
            starts += [(time_s, mark)] if mark.get("event") == "start" else []
            ends += [time_s] if mark.get("event") == "end" else []
        except (BadJson, AttributeError):
            continue
    if width not in names or not any("recording_id" in mark for _, mark in starts):
        return signals, {}, {}
    if f"{torque.removesuffix('-torque')}-pulses/channel" in names:
        raise BadRecord("pulses of several channels", place="stimrig-pulses", fix="Give the sealed recording.")
    if len(starts) > 1:
        raise BadRecord(f"it holds {len(starts)} tests", place="stimrig-tests", fix="Record each in a file of its own.")
    zero_s, mark = starts[0]
    end_s = ends[0] if ends else float("inf")
    told.append("cut to the test by its marks; time 0 is its start")
    cut = []
    for one in signals:
        kept = (one.time_s >= zero_s) & (one.time_s <= end_s)
        cut.append(replace(one, time_s=one.time_s[kept] - zero_s, values=one.values[kept]))
    own = {"torque_nm": f"{torque}:Nm", "pulse_width_us": f"{width}:us", "segments": "none", "sign": "+1"}
    return cut, own, {key: mark.get(key) for key in ("recording_id", "participant", "kind")}
