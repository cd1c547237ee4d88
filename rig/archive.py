"""Journal -> HDF5, as `docs/recording.md` lays it out, and the hashes that prove it unchanged.

The file is built in memory and then written as plain bytes to a temporary file, synced and renamed: a full disk
is then an error that can be told, not a crash within the HDF5 library.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from rig import align, journal
from rig.clock import utc_text
from rig.errors import RecordingError
from rig.journal import JournalContents, Kind
from rig.signals import SAMPLE, PulseStatus

FORMAT = "stimrig-recording"
FORMAT_VERSION = 1

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("torque/time_s", "s", "time of each sample on the test's clock, aligned with the pulses"),
    ("torque/torque_nm", "N·m", "elbow torque at native rate, zero offset not removed"),
    ("torque/counter", "1", "the cell's sample counter, unwrapped; -1 where the cell has none"),
    ("torque/host_time_s", "s", "when the host received the sample, test's clock"),
    ("torque/sync", "1", "stimulator's sync line as the cell saw it; 255 where there is none"),
    ("torque/gaps", "1", "rows: index of the first sample after a loss, how many are missing there"),
    ("pulses/planned_time_s", "s", "when the pulse was due"),
    ("pulses/pulse_width_us", "µs", "planned width of a phase; 0 is no pulse"),
    ("pulses/sent_pulse_width_us", "µs", "what was sent after the gate's rounding; NaN where nothing was sent"),
    ("pulses/current_ma", "mA", "current sent; 0 where nothing was sent"),
    (
        "pulses/written_time_s",
        "s",
        "when the last byte was handed to the line, at latest when its ack had been read; NaN where nothing was sent",
    ),
    ("pulses/acknowledged_time_s", "s", "when the device's ack had been read; NaN where none came"),
    (
        "pulses/status",
        "1",
        "0 acknowledged, 1 rest, 2 dropped because late, 3 refused, 4 unacknowledged, 5 device error",
    ),
    ("segments/start_s", "s", "start of the segment, test's clock"),
    ("segments/end_s", "s", "end of the segment, exclusive"),
)
"""Path, unit and description of each numeric dataset, in the order of `content_sha256`."""


@dataclass(slots=True)
class Recording:
    """A test as arrays: `columns` by the paths of `COLUMNS`, `names` of the segments, attributes of the root."""

    columns: dict[str, NDArray[Any]]
    names: list[str]
    attributes: dict[str, Any]
    alignment: align.Alignment
    events: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Sealed:
    """Where the recording is, and what proves it."""

    path: Path
    file_sha256: str
    content_sha256: str
    recording: Recording


def content_sha256(columns: dict[str, NDArray[Any]]) -> str:
    """SHA-256 over the raw little-endian bytes of the datasets, in the order of `COLUMNS`."""
    digest = hashlib.sha256()
    for path, _, _ in COLUMNS:
        column = columns[path]
        digest.update(np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def assemble(contents: JournalContents, outcome: str = "fault", reason: str = "") -> Recording:
    """A recording from a journal, whole or half-written.

    Parameters
    ----------
    contents
        What `journal.read` could read.
    outcome, reason
        Used where the journal does not say how the test ended.

    Raises
    ------
    RecordingError
        The journal ends before its header and plan: there is nothing to seal.
    """
    header = contents.first_json(Kind.HEADER)
    planned = next((np.frombuffer(p, "<f8") for k, p in contents.blocks if k == Kind.PLAN), None)
    if header is None or planned is None:
        raise RecordingError(f"journal {contents.path}: ends before the plan, no pulse was sent; nothing to seal")
    started = contents.first_json(Kind.START)
    start = started or {"t0_s": header["time_s"], "unix_s": header["unix_s"]}
    t0_s = float(start["t0_s"])
    end = contents.first_json(Kind.END) or {"outcome": outcome, "reason": reason, "time_s": _last_time(contents)}
    rate_hz = float(header["plan"]["pulse_rate_hz"])
    end_s = float(end["time_s"]) - t0_s
    played_s = min(end_s, float(end.get("stimulation_end_s", end["time_s"])) - t0_s) if started else 0.0
    columns, pulse_times = _pulses(contents, planned, rate_hz, t0_s, played_s)
    torque, alignment, measured_hz = _torque(contents, t0_s, end_s, pulse_times, float(header["sample_rate_hz"]))
    columns.update(torque)
    names = [s["name"] for s in header["segments"] if s["start"] / rate_hz < played_s]
    columns["segments/start_s"] = np.array([s["start"] / rate_hz for s in header["segments"][: len(names)]])
    ends = np.array([s["end"] / rate_hz for s in header["segments"][: len(names)]])
    columns["segments/end_s"] = np.minimum(ends, max(played_s, 0.0))
    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "recording_id": header["recording_id"],
        "test_id": header["plan"]["test_id"],
        "participant": header["plan"]["participant"],
        "kind": header["plan"]["kind"],
        "created_utc": utc_text(float(start["unix_s"])),
        "outcome": end["outcome"],
        "reason": end["reason"],
        "software": header["software"],
        "configuration": json.dumps({"rig": header["configuration"], "plan": header["plan"]}),
        "pulse_rate_hz": rate_hz,
        "sample_rate_hz": float(header["sample_rate_hz"]),
        "sample_rate_measured_hz": measured_hz,
        "current_ma": float(header["current_ma"]),
        "journal_damaged_bytes": contents.damaged_bytes,
        "journal_blocks_missing": contents.blocks_missing,
    }
    events = [json.loads(payload) for kind, payload in contents.blocks if kind == Kind.EVENT]
    return Recording(columns, names, attributes, alignment, events)


def _last_time(contents: JournalContents) -> float:
    """The newest time in a journal without an end."""
    newest = -np.inf
    for kind, payload in contents.blocks:
        if kind == Kind.TORQUE and len(payload) >= SAMPLE.itemsize:
            newest = max(newest, float(np.frombuffer(payload, SAMPLE)["host_time_s"][-1]))
        elif kind == Kind.WRITTEN:
            newest = max(newest, journal.WRITTEN.unpack(payload)[2])
        elif kind in (Kind.HEADER, Kind.START):
            content = json.loads(payload)
            newest = max(newest, content.get("time_s", content.get("t0_s", newest)))
    return newest


def _pulses(
    contents: JournalContents, planned: NDArray[Any], rate_hz: float, t0_s: float, played_s: float
) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
    n = len(planned)
    sent_us, current = np.full(n, np.nan), np.zeros(n)
    written_s, acked_s = np.full(n, np.nan), np.full(n, np.nan)
    status = np.where(planned == 0, PulseStatus.REST, PulseStatus.DROPPED).astype(np.uint8)
    for kind, payload in contents.blocks:
        if kind == Kind.INTENT:
            i, _, _, width_us, intent_ma = journal.INTENT.unpack(payload)
            if 0 <= i < n:
                sent_us[i], current[i], status[i] = width_us, intent_ma, PulseStatus.UNACKNOWLEDGED
        elif kind == Kind.WRITTEN:
            i, _, time_s = journal.WRITTEN.unpack(payload)
            written_s[i] = time_s - t0_s
        elif kind == Kind.SKIPPED:
            i, skipped, _ = journal.SKIPPED.unpack(payload)
            sent_us[i], current[i], status[i] = np.nan, 0.0, skipped
        elif kind == Kind.ACKED:
            i, time_s = journal.ACKED.unpack_from(payload)
            if 0 <= i < n:
                acked_s[i] = time_s - t0_s
                failed = len(payload) > journal.ACKED.size
                status[i] = PulseStatus.DEVICE_ERROR if failed else PulseStatus.ACKNOWLEDGED
    # the sender may lose the processor between its write and its look at the clock; the ack came after the write
    written_s = np.fmin(written_s, np.where(np.isfinite(written_s), acked_s, np.nan))
    sent_us[status == PulseStatus.REST] = 0.0
    tried = np.flatnonzero(np.nan_to_num(current) > 0)
    reached = max(int(np.clip(np.ceil(played_s * rate_hz - 1e-6), 0, n)), int(tried[-1]) + 1 if len(tried) else 0)
    columns: dict[str, NDArray[Any]] = {
        "pulses/planned_time_s": np.arange(n) / rate_hz,
        "pulses/pulse_width_us": planned.astype(np.float64),
        "pulses/sent_pulse_width_us": sent_us,
        "pulses/current_ma": current,
        "pulses/written_time_s": written_s,
        "pulses/acknowledged_time_s": acked_s,
        "pulses/status": status,
    }
    return {path: column[:reached] for path, column in columns.items()}, np.sort(written_s[np.isfinite(written_s)])


def _torque(
    contents: JournalContents, t0_s: float, end_s: float, written_s: NDArray[np.float64], sample_rate_hz: float
) -> tuple[dict[str, NDArray[Any]], align.Alignment, float]:
    blocks = [np.frombuffer(p, SAMPLE) for k, p in contents.blocks if k == Kind.TORQUE]
    samples = np.concatenate(blocks) if blocks else np.empty(0, SAMPLE)
    counter = samples["counter"].astype(np.int64)
    host_s = samples["host_time_s"] - t0_s
    cell_s = align.cell_time(counter, samples["stamp_s"], sample_rate_hz)
    time_s, alignment = align.align(cell_s, host_s, samples["sync"], written_s, sample_rate_hz)
    inside = np.flatnonzero((time_s >= 0) & (time_s < end_s))
    steps = np.diff(counter)
    after = np.flatnonzero((steps > 1) & (counter[:-1] >= 0)) + 1
    after = after[np.isin(after, inside) & np.isin(after - 1, inside)]
    gaps = np.column_stack([np.searchsorted(inside, after), steps[after - 1] - 1])
    measured_hz = sample_rate_hz / (1 + alignment.rate_ppm * 1e-6)
    columns: dict[str, NDArray[Any]] = {
        "torque/time_s": time_s[inside],
        "torque/torque_nm": samples["torque_nm"][inside],
        "torque/counter": counter[inside],
        "torque/host_time_s": host_s[inside],
        "torque/sync": samples["sync"][inside],
        "torque/gaps": gaps.astype(np.int64).reshape(-1, 2),
    }
    return columns, alignment, measured_hz


def to_bytes(recording: Recording) -> bytes:
    """The HDF5 file of a recording, built in memory."""
    with h5py.File("recording", "w", driver="core", backing_store=False) as file:
        for name, value in recording.attributes.items():
            file.attrs[name] = value
        file.attrs["content_sha256"] = content_sha256(recording.columns)
        for path, unit, description in COLUMNS:
            column = recording.columns[path]
            kwargs = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if column.size > 1000 else {}
            dataset = file.create_dataset(path, data=column, **kwargs)
            dataset.attrs["unit"], dataset.attrs["description"] = unit, description
        names = file.create_dataset("segments/name", data=recording.names, dtype=h5py.string_dtype())
        names.attrs["unit"], names.attrs["description"] = "", "rest, prbs, ramp, validate, or the user's own"
        group = file.create_group("alignment")
        for name in ("method", "error_ms", "delay_ms", "rate_ppm"):
            group.attrs[name] = getattr(recording.alignment, name)
        file.attrs["events"] = json.dumps(recording.events)
        file.flush()
        return bytes(file.id.get_file_image())


def write_atomically(path: Path, data: bytes) -> None:
    """Write to a temporary file beside `path`, sync, rename, sync the folder.

    Raises
    ------
    RecordingError
        The disk refused; nothing half-written is left.
    """
    temporary = None
    try:
        fd, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(fd, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o640)
        Path(temporary).rename(path)
        folder = os.open(path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise RecordingError(f"{path}: {error.strerror}; the journal is kept, free the disk and re-arm") from None


def seal(contents: JournalContents, folder: Path, outcome: str = "fault", reason: str = "") -> Sealed:
    """Seal a journal into `folder`, verify what was written, and say where it is.

    Raises
    ------
    RecordingError
        Nothing to seal, the disk refused, or the file read back differs; the journal is left alone.
    """
    try:
        recording = assemble(contents, outcome, reason)
    except (KeyError, IndexError, TypeError, struct.error) as error:
        raise RecordingError(f"journal {contents.path}: cannot be understood ({error!r}); it is kept") from None
    stamp = recording.attributes["created_utc"].replace("-", "").replace(":", "")[:15]
    path = folder / f"{stamp}Z_{recording.attributes['test_id']}.h5"
    data = to_bytes(recording)
    write_atomically(path, data)
    content = content_sha256(recording.columns)
    if verify(path) != content:
        raise RecordingError(f"{path}: reads back differently from what was written; the journal is kept")
    return Sealed(path, hashlib.sha256(data).hexdigest(), content, recording)


def verify(path: Path) -> str:
    """Read a sealed recording back and return its content's SHA-256.

    Raises
    ------
    RecordingError
        Not a recording, or its content does not match the hash that it carries.
    """
    try:
        with h5py.File(path, "r") as file:
            columns = {p: np.asarray(file[p]) for p, _, _ in COLUMNS}
            stated = str(file.attrs["content_sha256"])
    except (OSError, KeyError) as error:
        raise RecordingError(f"{path}: not a recording that can be read ({error})") from None
    actual = content_sha256(columns)
    if actual != stated:
        raise RecordingError(f"{path}: content does not match its SHA-256; it was changed after sealing")
    return actual
