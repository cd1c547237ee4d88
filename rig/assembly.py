"""Turns a journal into a recording (arrays); from a damaged journal it recovers what it can.

A journal contains header and plan twice. If both copies are damaged, they are inferred from the blocks: each pulse has
an intent with its width and current, then a block when it was written and one when it was acknowledged. `journal_note`
says what was inferred and what may be missing. No pulse that may have been felt is left out without a note.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import align, align_angle, journal
from stimrig.rig.align_angle import Reference
from stimrig.rig.clock import utc_text
from stimrig.rig.errors import RecordingError
from stimrig.rig.journal import JournalContents, Kind, LaidBlock
from stimrig.rig.messages import Labels
from stimrig.rig.signals import SAMPLE, PulseStatus, Segment

FORMAT = "stimrig-recording"
FORMAT_VERSION = 1
EVIDENCE = (Kind.START, Kind.INTENT, Kind.WRITTEN, Kind.SKIPPED, Kind.ACKED, Kind.TORQUE, Kind.ANGLE)
"""Blocks that show that the test had begun."""
LIKELY_RATE_HZ = 40.0
"""Assumed if neither header nor intents give the pulse rate."""


@dataclass(slots=True)
class Recording:
    """A test as arrays: `columns` by the paths of `archive.COLUMNS`, `names` of segments, attributes of the file.

    `angle` are the attributes of the group of that name; empty where the rig had no angle sensor.
    """

    columns: dict[str, NDArray[Any]]
    names: list[str]
    attributes: dict[str, Any]
    alignment: align.Alignment
    events: list[dict[str, Any]] = field(default_factory=list)
    angle: dict[str, Any] = field(default_factory=dict)


def assemble(contents: JournalContents, outcome: str = "fault", reason: str = "") -> Recording:
    """Make a recording from a journal, complete, partial or damaged.

    `contents`: what `journal.read` could read; `outcome`, `reason`: used if the journal does not say how the test
    ended. Raises RecordingError: there is nothing to seal, or the content is not valid.
    """
    try:
        return _assembled(contents, outcome, reason)
    except (KeyError, IndexError, TypeError, ValueError, struct.error) as error:
        raise RecordingError(f"journal {contents.path}: its content is not valid ({error!r}); it is kept") from None


def _assembled(contents: JournalContents, outcome: str, reason: str) -> Recording:
    _refuse_empty(contents)
    notes = []
    if contents.damaged:
        notes.append(
            f"the journal is damaged: {contents.damaged_bytes} bytes cannot be read and at least "
            f"{contents.blocks_missing} blocks are missing"
        )
    header = contents.first_json(Kind.HEADER) or _header_of_blocks(contents, notes)
    planned, segments = planned_pulses(contents, header, notes)
    rate_hz = float(header["plan"]["pulse_rate_hz"])
    begun, t0_s, unix_s = _start(contents, header, rate_hz)
    end = contents.first_json(Kind.END) or {"outcome": outcome, "reason": reason, "time_s": _last_time(contents)}
    end_s = float(end["time_s"]) - t0_s
    played_s = min(end_s, float(end.get("stimulation_end_s", end["time_s"])) - t0_s) if begun else 0.0
    pulses = _Pulses(planned, float(header["current_ma"]), t0_s)
    pulses.add(contents)
    columns = pulses.columns(rate_hz, played_s, contents.blocks_missing > 0, notes)
    written_s = columns["pulses/written_time_s"]
    pulse_times = np.sort(written_s[np.isfinite(written_s)])
    reference, alignment, measured_hz = _aligned(contents, t0_s, pulse_times, float(header["sample_rate_hz"]))
    columns.update(_torque(reference, end_s))
    of_angle, angle = align_angle.read_angles(contents, header, reference, end_s)
    columns.update(of_angle)
    segments = [s for s in segments if s.start / rate_hz < played_s]
    columns["segments/start_s"] = np.array([s.start / rate_hz for s in segments])
    columns["segments/end_s"] = np.minimum([s.end / rate_hz for s in segments], max(played_s, 0.0))
    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "recording_id": header["recording_id"],
        "test_id": header["plan"]["test_id"],
        **Labels.model_validate(header["plan"]).model_dump(exclude_none=True),
        "created_utc": utc_text(unix_s),
        "outcome": end["outcome"],
        "reason": end["reason"],
        "adaptive": int(bool(header["plan"].get("adaptive"))),
        "ended_by": end.get("ended_by", "plan") if end["outcome"] == "completed" else end["outcome"],
        "laid": json.dumps([block.described() for block in laid_blocks(contents)]),
        "software": header["software"],
        "configuration": json.dumps({"rig": header["configuration"], "plan": header["plan"]}),
        "pulse_rate_hz": rate_hz,
        "sample_rate_hz": float(header["sample_rate_hz"]),
        "sample_rate_measured_hz": measured_hz,
        "current_ma": float(header["current_ma"]),
        "journal_damaged_bytes": contents.damaged_bytes,
        "journal_blocks_missing": contents.blocks_missing,
        "journal_note": "; ".join(notes),
    }
    events = [json.loads(payload) for kind, payload in contents.blocks if kind == Kind.EVENT]
    return Recording(columns, [s.name for s in segments], attributes, alignment, events, angle)


def _refuse_empty(contents: JournalContents) -> None:
    """Raise RecordingError if neither header and plan nor any block shows that something was played."""
    kinds = {kind for kind, _ in contents.blocks}
    if kinds & set(EVIDENCE) or kinds >= {Kind.HEADER, Kind.PLAN}:
        return
    if contents.damaged:
        raise RecordingError(
            f"journal {contents.path}: {contents.damaged_bytes} bytes cannot be read, and the rest contains no "
            "pulse and no torque; it is kept"
        )
    raise RecordingError(f"journal {contents.path}: it ends before its plan, so no pulse was sent; nothing to seal")


def _header_of_blocks(contents: JournalContents, notes: list[str]) -> dict[str, Any]:
    """A header inferred from the blocks, if both copies are damaged."""
    intents = read_intents(contents)
    torque = [np.frombuffer(p, SAMPLE) for k, p in contents.blocks if k == Kind.TORQUE and len(p)]
    first_s = [float(samples["host_time_s"][0]) for samples in torque[:1]]
    rate_hz = LIKELY_RATE_HZ
    if len(intents) > 1 and intents[-1][0] > intents[0][0]:
        rate_hz = round((intents[-1][0] - intents[0][0]) / (intents[-1][2] - intents[0][2]), 6)
    else:
        notes.append(f"the pulse rate is unknown, {rate_hz:g} pulses/s were assumed")
    notes.append(
        "both copies of the header are lost: participant, limits, segments and devices are unknown; so is the time of "
        "the test, if its start is lost, too"
    )
    return {
        "recording_id": hashlib.sha256(b"".join(payload for _, payload in contents.blocks)).hexdigest()[:32],
        "plan": {
            "test_id": contents.path.stem,
            "participant": "unknown",
            "kind": "recovered",
            "pulse_rate_hz": rate_hz,
        },
        "segments": [],
        "current_ma": max((intent[4] for intent in intents), default=0.0),
        "sample_rate_hz": (len(torque) > 1 and align.counted_rate_hz(np.concatenate(torque))) or 1.0,
        "software": "unknown",
        "configuration": {},
        "time_s": min([*(intent[1] for intent in intents[:1]), *first_s], default=0.0),
        "unix_s": contents.path.stat().st_mtime if contents.path.exists() else 0.0,
    }


def _start(contents: JournalContents, header: dict[str, Any], rate_hz: float) -> tuple[bool, float, float]:
    """Return whether the test began, and the start of its clock: on the rig's clock, s, and as UTC."""
    started = contents.first_json(Kind.START)
    if started is not None:
        return True, float(started["t0_s"]), float(started["unix_s"])
    intents = read_intents(contents)
    t0_s = float(header["time_s"])
    if intents:
        t0_s = float(np.median([due_s - index / rate_hz for index, _, due_s, _, _ in intents]))
    return bool(intents), t0_s, float(header["unix_s"]) + t0_s - float(header["time_s"])


def _last_time(contents: JournalContents) -> float:
    """The latest time in a journal without an end."""
    newest = -np.inf
    for kind, payload in contents.blocks:
        if kind == Kind.TORQUE and len(payload) >= SAMPLE.itemsize:
            newest = max(newest, float(np.frombuffer(payload, SAMPLE)["host_time_s"][-1]))
        elif kind == Kind.WRITTEN:
            newest = max(newest, journal.WRITTEN.unpack(payload)[2])
        elif kind in (Kind.HEADER, Kind.START):
            content = json.loads(payload)
            newest = max(newest, content.get("time_s", content.get("t0_s", newest)))
    return newest if np.isfinite(newest) else 0.0


class _Pulses:
    """Outcome of each planned pulse."""

    def __init__(self, planned: NDArray[Any], current_ma: float, t0_s: float) -> None:
        n = len(planned)
        self._planned, self._current_ma, self._t0_s = planned, current_ma, t0_s
        self._sent_us, self._current = np.full(n, np.nan), np.zeros(n)
        self._written_s, self._acked_s = np.full(n, np.nan), np.full(n, np.nan)
        self._status = np.where(planned == 0, PulseStatus.REST, PulseStatus.DROPPED).astype(np.uint8)
        self._intended, self._mentioned = np.zeros(n, bool), np.zeros(n, bool)

    def add(self, contents: JournalContents) -> None:
        for kind, payload in contents.blocks:
            if kind not in (Kind.INTENT, Kind.WRITTEN, Kind.SKIPPED, Kind.ACKED):
                continue
            i = struct.unpack_from("<i", payload)[0]
            if not (0 <= i < len(self._planned)):
                continue
            self._mentioned[i] = True
            if kind == Kind.INTENT:
                _, _, _, self._sent_us[i], self._current[i] = journal.INTENT.unpack(payload)
                self._intended[i], self._status[i] = True, PulseStatus.UNACKNOWLEDGED
            elif kind == Kind.WRITTEN:
                self._written_s[i] = journal.WRITTEN.unpack(payload)[2] - self._t0_s
            elif kind == Kind.SKIPPED:
                self._sent_us[i], self._current[i], self._status[i] = np.nan, 0.0, journal.SKIPPED.unpack(payload)[1]
            else:
                self._acked_s[i] = journal.ACKED.unpack_from(payload)[1] - self._t0_s
                failed = len(payload) > journal.ACKED.size
                self._status[i] = PulseStatus.DEVICE_ERROR if failed else PulseStatus.ACKNOWLEDGED

    def columns(
        self, rate_hz: float, played_s: float, blocks_missing: bool, notes: list[str]
    ) -> dict[str, NDArray[Any]]:
        n = len(self._planned)
        reached = int(np.clip(np.ceil(played_s * rate_hz - 1e-6), 0, n))
        self._without_intent(notes)
        if blocks_missing:
            self._without_trace(reached, notes)
        tried = np.flatnonzero((self._current > 0) | np.isfinite(self._written_s))
        reached = max(reached, int(tried[-1]) + 1 if len(tried) else 0)
        # the sender may be interrupted between its write and its reading of the clock; the ack came after the write
        acked_s = np.where(np.isfinite(self._written_s), self._acked_s, np.nan)
        self._sent_us[self._status == PulseStatus.REST] = 0.0
        columns: dict[str, NDArray[Any]] = {
            "pulses/planned_time_s": np.arange(n) / rate_hz,
            "pulses/pulse_width_us": self._planned.astype(np.float64),
            "pulses/sent_pulse_width_us": self._sent_us,
            "pulses/current_ma": self._current,
            "pulses/written_time_s": np.fmin(self._written_s, acked_s),
            "pulses/acknowledged_time_s": self._acked_s,
            "pulses/status": self._status,
        }
        return {path: column[:reached] for path, column in columns.items()}

    def _without_intent(self, notes: list[str]) -> None:
        """Pulses that were sent but have no intent: use their planned values."""
        sent = ~self._intended & (np.isfinite(self._written_s) | np.isfinite(self._acked_s))
        if not sent.any():
            return
        silent = sent & ~np.isfinite(self._acked_s)
        self._status[silent] = PulseStatus.UNACKNOWLEDGED
        self._as_planned(sent)
        notes.append(
            "1 pulse was sent whose intent is lost: its planned value is used"
            if sent.sum() == 1
            else f"{int(sent.sum())} pulses were sent whose intents are lost: their planned values are used"
        )
        if unknown := int(np.sum(sent & (self._planned == 0))):
            notes.append(f"the width of {unknown} of them is unknown")

    def _without_trace(self, reached: int, notes: list[str]) -> None:
        """Planned pulses without any block: they may have been felt, so they count as unacknowledged."""
        lost = ~self._mentioned & (self._planned > 0)
        lost[reached:] = False
        if not lost.any():
            return
        self._status[lost] = PulseStatus.UNACKNOWLEDGED
        self._as_planned(lost)
        notes.append(
            f"{int(lost.sum())} planned pulses have no block: they may have been felt and count as unacknowledged"
        )

    def _as_planned(self, which: NDArray[np.bool_]) -> None:
        known = which & (self._planned > 0)
        self._sent_us[known] = np.floor(self._planned[known])
        self._current[known] = self._current_ma


def _aligned(
    contents: JournalContents, t0_s: float, written_s: NDArray[np.float64], sample_rate_hz: float
) -> tuple[Reference, align.Alignment, float]:
    """All torque samples with their times on the test's clock, how these were obtained, samples per second."""
    blocks = [np.frombuffer(p, SAMPLE) for k, p in contents.blocks if k == Kind.TORQUE]
    samples = np.concatenate(blocks) if blocks else np.empty(0, SAMPLE)
    cell_s = align.cell_time(samples["counter"].astype(np.int64), samples["stamp_s"], sample_rate_hz)
    host_s = samples["host_time_s"] - t0_s
    time_s, alignment = align.align(cell_s, host_s, samples["sync"], written_s, sample_rate_hz)
    measured_hz = sample_rate_hz / (1 + alignment.rate_ppm * 1e-6)
    return Reference(samples, time_s, t0_s, alignment.error_ms), alignment, measured_hz


def _torque(of: Reference, end_s: float) -> dict[str, NDArray[Any]]:
    counter = of.samples["counter"].astype(np.int64)
    inside = np.flatnonzero((of.time_s >= 0) & (of.time_s < end_s))
    steps = np.diff(counter)
    after = np.flatnonzero((steps > 1) & (counter[:-1] >= 0)) + 1
    after = after[np.isin(after, inside) & np.isin(after - 1, inside)]
    gaps = np.column_stack([np.searchsorted(inside, after), steps[after - 1] - 1])
    return {
        "torque/time_s": of.time_s[inside],
        "torque/torque_nm": of.samples["torque_nm"][inside],
        "torque/counter": counter[inside],
        "torque/host_time_s": (of.samples["host_time_s"] - of.t0_s)[inside],
        "torque/sync": of.samples["sync"][inside],
        "torque/gaps": gaps.astype(np.int64).reshape(-1, 2),
    }


Floats = NDArray[np.float64]
Intent = tuple[int, float, float, float, float]


def read_intents(contents: JournalContents) -> list[Intent]:
    """Index, time, due time, width and current of each pulse that was to be sent."""
    return [journal.INTENT.unpack(payload) for kind, payload in contents.blocks if kind == Kind.INTENT]


def laid_blocks(contents: JournalContents) -> list[LaidBlock]:
    return [LaidBlock.from_bytes(payload) for kind, payload in contents.blocks if kind == Kind.EXTENSION]


def planned_pulses(contents: JournalContents, header: dict[str, Any], notes: list[str]) -> tuple[Floats, list[Segment]]:
    """Planned width of each pulse, µs, shape (n,), and the segments; notes say what was inferred.

    A lost block is replaced by the intents: they hold the widths that were sent.
    """
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
        if kind == Kind.EXTENSION:
            block = LaidBlock.from_bytes(payload)
            yield block.segment.start, block
        elif kind == Kind.EVENT and (event := json.loads(payload))["event"] == "ended":
            yield event["index"], None


def _filled(widths_us: Floats, sent_us: Floats, end: int, notes: list[str], noted: bool) -> Floats:
    """The widths up to pulse `end`; what is missing is taken from what was sent, 0 where nothing was."""
    missing = end - len(widths_us)
    if missing <= 0:
        return widths_us[:end]
    found_us = np.zeros(missing)
    known_us = sent_us[len(widths_us) : end]
    found_us[: len(known_us)] = known_us
    if not noted:
        notes.append(
            f"which segments pulses {len(widths_us) + 1} to {end} belonged to is lost: the widths that were sent are "
            "used as planned widths"
        )
    return np.concatenate([widths_us, found_us])


def _sent(contents: JournalContents) -> Floats:
    """Widths by the intents, up to the last pulse of which any block speaks, µs."""
    known = [journal.SKIPPED.unpack(p)[0] for k, p in contents.blocks if k in (Kind.WRITTEN, Kind.SKIPPED)]
    known += [journal.ACKED.unpack_from(p)[0] for k, p in contents.blocks if k == Kind.ACKED]
    intents = read_intents(contents)
    known += [intent[0] for intent in intents]
    widths_us = np.zeros(max(known, default=-1) + 1)
    for index, _, _, width_us, _ in intents:
        widths_us[index] = width_us
    return widths_us
