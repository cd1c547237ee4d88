"""What a journal says was to be played: the plan, and of an adaptive test the segments that were laid after its start.

A lost block is replaced by the intents: they hold the widths that were sent.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import journal
from stimrig.rig.journal import JournalContents, Kind, LaidBlock, Segment

Floats = NDArray[np.float64]
Intent = tuple[int, float, float, float, float]


def intents(contents: JournalContents) -> list[Intent]:
    """Index, time, due time, width and current of each pulse that was to be sent."""
    return [journal.INTENT.unpack(payload) for kind, payload in contents.blocks if kind == Kind.INTENT]


def laid_blocks(contents: JournalContents) -> list[LaidBlock]:
    """Segments that were laid after the start, in order."""
    return [LaidBlock.of_bytes(payload) for kind, payload in contents.blocks if kind == Kind.LAID]


def planned(contents: JournalContents, header: dict[str, Any], notes: list[str]) -> tuple[Floats, list[Segment]]:
    """Planned width of each pulse, µs, shape (n,), and the segments; notes say what was inferred."""
    plan = next((np.frombuffer(p, "<f8") for k, p in contents.blocks if k == Kind.PLAN), None)
    if plan is None:
        notes.append("both copies of the plan are lost: the widths that were sent are used as planned widths")
    widths_us = np.empty(0) if plan is None else plan
    segments = [Segment(s["name"], s["start"], s["end"], s.get("by", "plan")) for s in header["segments"]]
    sent_us = _sent(contents) if plan is None or header["plan"].get("adaptive") else np.empty(0)
    for cut, block in _growth(contents):
        widths_us = _filled(widths_us, sent_us, cut, notes, plan is None)
        segments = [s._replace(end=min(s.end, cut)) for s in segments if s.start < cut]
        if block is not None and block.segment.end > cut:
            widths_us = np.concatenate([widths_us, block.pulse_width_us])
            segments.append(block.segment)
    return _filled(widths_us, sent_us, max(len(widths_us), len(sent_us)), notes, plan is None), segments


def _growth(contents: JournalContents) -> Iterator[tuple[int, LaidBlock | None]]:
    """Pulses up to which all stayed as it was, and what was laid after them; None: only the end was written."""
    for kind, payload in contents.blocks:
        if kind == Kind.LAID:
            block = LaidBlock.of_bytes(payload)
            yield block.segment.start, block
        elif kind == Kind.EVENT and (event := json.loads(payload))["event"] == "ended":
            yield event["index"], None


def _filled(widths_us: Floats, sent_us: Floats, end: int, notes: list[str], told: bool) -> Floats:
    """The widths up to pulse `end`; what is missing is taken from what was sent, 0 where nothing was."""
    missing = end - len(widths_us)
    if missing <= 0:
        return widths_us[:end]
    found_us = np.zeros(missing)
    known_us = sent_us[len(widths_us) : end]
    found_us[: len(known_us)] = known_us
    if not told:
        notes.append(
            f"which segments pulses {len(widths_us) + 1} to {end} belonged to is lost: the widths that were sent are "
            "used as planned widths"
        )
    return np.concatenate([widths_us, found_us])


def _sent(contents: JournalContents) -> Floats:
    """Widths by the intents, up to the last pulse of which any block speaks, µs."""
    known = [journal.SKIPPED.unpack(p)[0] for k, p in contents.blocks if k in (Kind.WRITTEN, Kind.SKIPPED)]
    known += [journal.ACKED.unpack_from(p)[0] for k, p in contents.blocks if k == Kind.ACKED]
    asked = intents(contents)
    known += [intent[0] for intent in asked]
    widths_us = np.zeros(max(known, default=-1) + 1)
    for index, _, _, width_us, _ in asked:
        widths_us[index] = width_us
    return widths_us
