"""A record read for handing on: what the file itself holds, and what `identify` makes of it."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from stimrig.api.cohort.record import read
from stimrig.api.cohort.select import Known
from stimrig.identify.records import HDF5_MAGIC
from stimrig.identify.records.bounds import LONGEST_PLAN
from stimrig.identify.records.hdf5 import StrictFile

TORQUE = ("counter", "host_time_s", "sync")
PULSES = (
    "planned_time_s", "pulse_width_us", "sent_pulse_width_us", "current_ma", "written_time_s", "acknowledged_time_s",
    "status",
)  # fmt: skip
"""What a recording holds of its torque's samples, and of its pulses."""
NUMBERS = ("pulse_rate_hz", "sample_rate_hz", "sample_rate_measured_hz", "current_ma")
TEXTS = ("reason", "content_sha256", "journal_note", "ended_by", "laid", "events", "configuration")
ANGLE = ("time_s", "angle_rad", "velocity_rad_s")
ALIGNMENT = ("error_ms", "delay_ms", "rate_ppm")
NO_SYNC = 255


@dataclass
class WholeRecord:
    """One record."""

    sha256: str
    about: dict[str, Any]  # fields of `stimrig.api.cohort.select` and attributes of the recording
    samples: dict[str, NDArray[Any]]
    """Shape (N,); all torque samples, those outside of every segment, too; a column that the record lacks is not
    there."""
    pulses: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Shape (P,); what was planned, sent and heard of each pulse; empty for a record without a list of its pulses."""
    segments: list[tuple[str, float, float]] = field(default_factory=list)  # end exclusive
    notes: tuple[str, ...] = ()  # what was assumed when it was read
    angle: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """Shape (A,); an angle sensor's own `time_s`, `angle_rad`, `velocity_rad_s`; empty where the rig had none."""
    record: Any = None  # as `identify` reads it, for what is computed of it

    @property
    def sample_rate_hz(self) -> float:
        """Samples a second, gaps aside."""
        time_s = self.samples["time_s"]
        steps = np.diff(time_s)
        if not len(steps):
            return float(self.about.get("sample_rate_hz") or self.about["pulse_rate_hz"])
        steps = steps[steps < 1.5 * np.median(steps)]
        return float(len(steps) / np.sum(steps))


def read_whole(content: bytes, path: Path, known: Known, columns: Sequence[str] = ()) -> WholeRecord:
    """Read a record whose bytes lie at `path`, too, and of which this is known (`describe`).

    Raises BadRecord: as `identify.read` does.
    """
    said, sealed = dict(known), content.startswith(HDF5_MAGIC)
    record = read(path, () if sealed else columns, said)
    said |= {
        "pulse_rate_hz": float(record.pulse_rate_hz),
        "bytes": len(content),
        "format": "sealed recording" if sealed else "table",
    }
    found = WholeRecord(hashlib.sha256(content).hexdigest(), said, {}, notes=tuple(record.notes), record=record)
    if sealed:
        _sealed(found, record, content, path)
    else:
        _table(found, record)
    return found


def _sealed(found: WholeRecord, record: Any, content: bytes, path: Path) -> None:
    """Everything that the file holds; what `identify` made of it beside the samples that it took."""
    file = StrictFile(content, str(path))
    found.about |= {name: number for name in NUMBERS if np.isfinite(number := file.number(name, np.nan))}
    found.about |= {name: text for name in TEXTS if (text := file.text(name, "", LONGEST_PLAN))}
    found.about |= _alignment(content)
    time_s = file.numbers("/torque/time_s")
    size = len(time_s)
    taken = np.searchsorted(time_s, record.time_s)  # they are some of these times, unchanged
    found.samples = {
        "time_s": time_s,
        "torque_nm": file.numbers("/torque/torque_nm"),
        "pulse_width_us": _spread(record.pulse_width_us, taken, size, np.nan),
        "segment": _spread(record.segment, taken, size, -1),
        "late_s": _spread(np.zeros(len(taken)) if record.late_s is None else record.late_s, taken, size, np.nan),
        "doubted": _spread(np.zeros(len(taken)) if record.doubted is None else record.doubted, taken, size, np.nan),
        "part": np.zeros(size),
    }
    for name in TORQUE:
        if file.has(place := f"/torque/{name}") and len(column := file.numbers(place)) == size:
            found.samples[name] = np.where(column == {"sync": NO_SYNC, "counter": -1}.get(name), np.nan, column)
    planned = file.numbers("/pulses/planned_time_s") if file.has("/pulses/planned_time_s") else np.empty(0)
    for name in PULSES:
        if file.has(place := f"/pulses/{name}") and len(column := file.numbers(place)) == len(planned):
            found.pulses[name] = column
    if file.has("/angle"):
        found.angle = dict(zip(ANGLE, file.columns("/angle", ANGLE, "columns of different lengths"), strict=True))
    names = tuple(record.segment_names)
    rows = zip(
        file.names("/segments/name"), file.numbers("/segments/start_s"), file.numbers("/segments/end_s"), strict=True
    )
    found.segments = [(name, float(start), float(end)) for name, start, end in rows]
    found.about["segment_names"] = list(names)


def _table(found: WholeRecord, record: Any) -> None:
    size = len(record.time_s)
    found.samples = {
        "time_s": record.time_s,
        "torque_nm": record.torque_nm,
        "pulse_width_us": record.pulse_width_us,
        "segment": record.segment.astype(float),
        "part": record.part.astype(float),
        **{name: np.asarray(column, float) for name, column in record.columns().items()},
    }
    starts = np.flatnonzero(np.r_[True, np.diff(record.segment) != 0])
    ends = np.r_[starts[1:], size]
    step_s = 1 / record.sample_rate_hz
    found.segments = [
        (record.segment_names[record.segment[a]], float(record.time_s[a]), float(record.time_s[b - 1]) + step_s)
        for a, b in zip(starts, ends, strict=True)
    ]
    found.about["segment_names"] = list(record.segment_names)


def _spread(values: NDArray[Any], places: NDArray[np.int64], size: int, elsewhere: float) -> NDArray[np.float64]:
    column = np.full(size, elsewhere, float)
    column[places] = values
    return column


def _alignment(content: bytes) -> dict[str, Any]:
    """How exact the times are; nothing where the file does not plainly say it."""
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            linked = isinstance(file.get("alignment", getlink=True), h5py.HardLink)
            group = file["alignment"] if linked else None
            said = (
                {name: group.attrs.get(name) for name in (*ALIGNMENT, "method")}
                if isinstance(group, h5py.Group)
                else {}
            )
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return {}
    numbers = {name: value for name, value in said.items() if isinstance(value, float | np.floating)}
    found: dict[str, Any] = {
        f"alignment_{name}": float(value) if np.isfinite(value) else None for name, value in numbers.items()
    }
    method = said.get("method")
    known = isinstance(method, str) and method in ("sync", "regression")
    return {**found, **({"alignment_method": method} if known else {})}
