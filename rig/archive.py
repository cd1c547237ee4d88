"""Writes a recording to HDF5, as `docs/recording.md` describes, with hashes that prove it unchanged.

The file is built in memory, then written as plain bytes. So a full disk gives an error message, not a crash inside the
HDF5 library.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from stimrig.rig.assembly import Recording
from stimrig.rig.errors import RecordingError
from stimrig.rig.machine import Disk

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
        "when the last byte was written to the line, at the latest when its ack was read; NaN where nothing was sent",
    ),
    ("pulses/acknowledged_time_s", "s", "when the device's ack was read; NaN where none came"),
    (
        "pulses/status",
        "1",
        "0 acknowledged, 1 rest, 2 dropped (late, or the one before was not acknowledged), 3 refused, "
        "4 unacknowledged, 5 device error",
    ),
    ("segments/start_s", "s", "start of the segment, test's clock"),
    ("segments/end_s", "s", "end of the segment, exclusive"),
)
"""Path, unit and description of each numeric dataset, in the order of `content_sha256`."""

ANGLE_COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("angle/time_s", "s", "time of each sample on the test's clock, aligned with the pulses"),
    ("angle/angle_rad", "rad", "joint angle; elbow: 0 is a straight arm, flexion is positive"),
    ("angle/velocity_rad_s", "rad/s", "its derivative, by the method that the group's attributes state"),
    ("angle/raw", "1", "what the sensor gave, in its own unit"),
    ("angle/counter", "1", "the sensor's sample counter, unwrapped; -1 where it has none"),
    ("angle/host_time_s", "s", "when the host received the sample, test's clock"),
    ("angle/gaps", "1", "rows: index of the first sample after a loss, how many are missing there"),
)
"""The same, after the others, of a rig with an angle sensor: all of them, or none."""

MOST_BYTES = 10**9
"""Most bytes of a recording's values: three hours at 1600 Hz. A damaged file that declares more is not read."""


def layout(columns: Collection[str]) -> tuple[tuple[str, str, str], ...]:
    """The datasets of a recording that has these paths."""
    return COLUMNS + ANGLE_COLUMNS if any(path.startswith("angle/") for path in columns) else COLUMNS


@dataclass(frozen=True, slots=True)
class Sealed:
    """A sealed recording: its file and its hashes."""

    path: Path
    file_sha256: str
    content_sha256: str
    recording: Recording


def content_sha256(columns: dict[str, NDArray[Any]]) -> str:
    """SHA-256 over the raw little-endian bytes of the datasets, in the order of `layout`."""
    digest = hashlib.sha256()
    for path, _, _ in layout(columns):
        column = columns[path]
        digest.update(np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def to_bytes(recording: Recording) -> bytes:
    """The HDF5 file of a recording, built in memory."""
    with h5py.File("recording", "w", driver="core", backing_store=False) as file:
        for name, value in recording.attributes.items():
            file.attrs[name] = _text(value) if isinstance(value, str) else value
        file.attrs["content_sha256"] = content_sha256(recording.columns)
        for path, unit, description in layout(recording.columns):
            column = recording.columns[path]
            kwargs = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if column.size > 1000 else {}
            dataset = file.create_dataset(path, data=column, **kwargs)
            dataset.attrs["unit"], dataset.attrs["description"] = unit, description
        names = file.create_dataset(
            "segments/name", data=[_text(name) for name in recording.names], dtype=h5py.string_dtype()
        )
        names.attrs["unit"], names.attrs["description"] = "", "rest, prbs, ramp, validate, or the user's own"
        group = file.create_group("alignment")
        for name in ("method", "error_ms", "delay_ms", "rate_ppm"):
            group.attrs[name] = getattr(recording.alignment, name)
        for name, value in recording.angle.items():
            file["angle"].attrs[name] = _text(value) if isinstance(value, str) else value
        file.attrs["events"] = json.dumps(recording.events)
        file.flush()
        return bytes(file.id.get_file_image())


def _text(value: str) -> str:
    """HDF5 takes no NUL in a text, nor half of a surrogate pair: no reason or name may leave a test unsealed."""
    return value.replace("\0", "\N{REPLACEMENT CHARACTER}").encode("utf-8", "replace").decode()


def place(recording: Recording, folder: Path) -> Path:
    stamp = recording.attributes["created_utc"].replace("-", "").replace(":", "")[:15]
    return folder / f"{stamp}Z_{recording.attributes['test_id']}.h5"


def seal(recording: Recording, folder: Path, disk: Disk) -> Sealed:
    """Seal a recording into `folder` and verify what was written.

    Raises RecordingError: disk error, or the file reads back differently; the journal is not touched.
    """
    path = place(recording, folder)
    data = to_bytes(recording)
    try:
        disk.replace(path, data)
        written = disk.read(path)
    except OSError as error:
        raise RecordingError(
            f"{path}: {error.strerror}; the journal is kept; free some disk space and re-arm"
        ) from None
    content = content_sha256(recording.columns)
    if verify(path, io.BytesIO(written)) != content:
        raise RecordingError(f"{path}: reads back differently from what was written; the journal is kept")
    return Sealed(path, hashlib.sha256(data).hexdigest(), content, recording)


def _numbers(item: object) -> h5py.Dataset:
    if not isinstance(item, h5py.Dataset):
        raise TypeError("a group stands in a dataset's place")
    if item.dtype.kind not in "biuf":
        raise TypeError(f"{item.name} holds no numbers")
    return item


def verify(path: Path, file: io.BytesIO | None = None) -> str:
    """Read a sealed recording back and return its content's SHA-256; `file`: what was read of it already.

    Raises RecordingError: not a recording, or its content does not match its hash.
    """
    try:
        with h5py.File(file or path, "r") as opened:
            expected = layout(["angle/"] if "angle" in opened else [])
            datasets = {p: _numbers(opened[p]) for p, _, _ in expected}
            if sum(dataset.nbytes for dataset in datasets.values()) > MOST_BYTES:
                raise ValueError(f"it has more than {MOST_BYTES:.0e} bytes of values; no test is so long")
            columns = {p: np.asarray(dataset) for p, dataset in datasets.items()}
            stated = str(opened.attrs["content_sha256"])
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:  # h5py raises each of them
        raise RecordingError(f"{path}: not a readable recording ({error})") from None
    actual = content_sha256(columns)
    if actual != stated:
        raise RecordingError(f"{path}: content does not match its SHA-256; it was changed after sealing")
    return actual
