"""NWB 2 in, by the strict reader of HDF5: series with their times, and tables of intervals; no library follows a link.

Links within the file are followed (series share times by them), links to elsewhere are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue]

from stimrig.api.exchange.inward.foreign import FIX, MOST_SIGNALS, Foreign, Signal, Spans, plain
from stimrig.identify.errors import BadRecord
from stimrig.identify.json_text import BadJson, parse
from stimrig.identify.records import HDF5_MAGIC
from stimrig.identify.records.bounds import LARGEST_ROWS, LONGEST_PLAN, LONGEST_TEXT
from stimrig.identify.records.hdf5 import ELSEWHERE, FILTERS, LARGEST_CHUNK_BYTES, StrictFile

NAME = "NWB"
MOST_LINKS = 8
ROOMS = ("/acquisition", "/stimulus/presentation", "/processing", "/analysis")
DEEPEST = 4
MOST_NUMBERS = 8 * LARGEST_ROWS
SMALL = {1e-6: {"s": "us", "N": "", "Nm": ""}, 1e-3: {"s": "ms", "Nm": "mNm", "N": "mN", "rad": "mrad"}}
"""A unit and its conversion that are a unit of their own: the numbers stay as they were written."""
OWN = {
    "torque_nm": "torque", "pulse_width_us": "pulse_width_in_force", "segments": "segments", "sign": "+1",
    "late_s": "lateness", "doubted": "doubted", "angle_rad": "joint_angle", "velocity_rad_s": "joint_velocity",
}  # fmt: skip
LABELS = ("segment", "label", "tags", "name", "condition", "stimulus_type")


class NwbFile(StrictFile):
    """An NWB file, from its bytes."""

    def _find(self, path: str) -> Any:
        """As of any file; a link to another place of this one is followed."""
        here, left = self._root, MOST_LINKS
        parts = [part for part in path.split("/") if part]
        while parts:
            name = parts.pop(0).encode()
            if not isinstance(here, h5g.GroupID) or not here.links.exists(name):
                return None
            kind = here.links.get_info(name).type
            if kind == h5l.TYPE_SOFT and left:
                target = here.links.get_val(name).decode("utf-8", "replace")
                parts, left = [*target.strip("/").split("/"), *parts], left - 1
                here = self._root if target.startswith("/") else here
            elif kind != h5l.TYPE_HARD:
                return ELSEWHERE
            else:
                here = h5o.open(here, name)
        return here

    def bad(self, message: str, path: str = "") -> BadRecord:
        """As of any file, with another way out."""
        return BadRecord(message, place=f"{self.name}, {path}" if path else self.name, fix=FIX)

    def children(self, path: str) -> list[str]:
        """What a group holds; nothing where it is none."""
        with self._asking(path):
            group = self._find(path)
            if not isinstance(group, h5g.GroupID):
                return []
            if group.get_num_objs() > MOST_SIGNALS:
                raise self.bad(f"more than {MOST_SIGNALS} objects", path)
            return [name.decode("utf-8", "replace") for name in group]

    def attribute(self, path: str, name: str, default: Any) -> Any:
        """A text or a number that is an attribute; the default where there is none, or something else."""
        with self._asking(path):
            here = self._find(path)
            if here is None or here is ELSEWHERE or not h5a.exists(here, name.encode()):
                return default
            found = h5a.open(here, name.encode())
            kind, space = found.get_type(), found.get_space()
            known = kind.get_class() in (h5t.STRING, h5t.INTEGER, h5t.FLOAT) and kind.get_size() <= LONGEST_TEXT
            if not known or space.get_simple_extent_type() != h5s.SCALAR:
                return default
            wrap = h5py.Dataset if isinstance(here, h5d.DatasetID) else h5py.Group
            value = wrap(here).attrs[name]
        value = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(default, float):
            return float(value) if isinstance(value, int | float | np.number) else default
        return str(value)[:LONGEST_TEXT]

    def scalar(self, path: str) -> Any:
        """A dataset of one text or number; None where there is none."""
        if not self.has(path):
            return None
        dataset = self._dataset(path) if self._is_dataset(path) else None
        if dataset is None or dataset.get_space().get_simple_extent_type() != h5s.SCALAR:
            return None
        kind = dataset.get_type()
        if kind.get_class() not in (h5t.STRING, h5t.INTEGER, h5t.FLOAT) or kind.get_size() > LONGEST_PLAN:
            return None
        with self._asking(path):
            value = h5py.Dataset(dataset)[()]
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else value

    def _is_dataset(self, path: str) -> bool:
        with self._asking(path):
            return isinstance(self._find(path), h5d.DatasetID)

    def table(self, path: str) -> np.ndarray:
        """A dataset of one or two dimensions as float64, shape (N, C).

        Raises BadRecord: no plain numbers, more than a record has, or not in this file.
        """
        dataset = self._dataset(path)
        shape = dataset.get_space().get_simple_extent_dims()
        if len(shape) == 1:
            return self.numbers(path)[:, None]
        plan, kind = dataset.get_create_plist(), dataset.get_type()
        if len(shape) != 2 or shape[0] * max(shape[1], 1) > LARGEST_ROWS:
            raise self.bad(f"{'×'.join(map(str, shape))} values; one or two dimensions are read", path)
        if kind.get_class() not in (h5t.INTEGER, h5t.FLOAT) or kind.get_size() > 8:
            raise self.bad("no plain numbers", path)
        if plan.get_layout() == h5d.CHUNKED:
            filters = [plan.get_filter(index)[0] for index in range(plan.get_nfilters())]
            large = int(np.prod(plan.get_chunk(), dtype=float)) * kind.get_size() > LARGEST_CHUNK_BYTES
            if large or set(filters) - set(FILTERS) or not dataset.get_num_chunks():
                raise self.bad("chunks that are too large, packed in another way, or not there", path)
        with self._asking(path):
            return np.asarray(h5py.Dataset(dataset)[()], float)


def reads(path: Path, head: bytes) -> bool:
    """Whether it calls itself NWB; that it is one, reading tells."""
    return head.startswith(HDF5_MAGIC) and path.suffix.lower() == ".nwb"


def read(path: Path, content: bytes) -> Foreign:
    """What an NWB file holds. Raises BadRecord."""
    file = NwbFile(content, str(path))
    if not str(file.attribute("/", "nwb_version", "")).startswith("2"):
        raise BadRecord("no NWB file of version 2", place=str(path), fix="Convert it with pynwb first.")
    signals = tuple(_bounded(file))
    spans = tuple(_spans(file))
    own = _own(file, signals, spans)
    identity = str(file.scalar("/identifier") or "")
    about = {
        "participant": file.scalar("/general/subject/subject_id"),
        "recording_id": identity.rpartition(" ")[0] if own else identity,
        "session_start_time": file.scalar("/session_start_time"),
    }
    return Foreign(NAME, signals, spans, own, {key: value for key, value in about.items() if value})


def _own(file: NwbFile, signals: tuple[Signal, ...], spans: tuple[Spans, ...]) -> dict[str, str]:
    """The answers, where our export wrote the file."""
    try:
        said = parse(str(file.scalar("/general/notes") or ""))["stimrig"]
        rate_hz = float(said["pulse_rate_hz"])
    except (BadJson, KeyError, TypeError, ValueError):
        return {}
    there = {one.name for one in (*signals, *spans)} | {"+1"}
    units = {one.name: one.unit for one in signals}
    own = {
        option: f"{name}:{units[name]}" if units.get(name) else name for option, name in OWN.items() if name in there
    }
    return {**own, "pulse-rate-hz": repr(rate_hz)} if {"torque_nm", "pulse_width_us"} <= own.keys() else {}


def _bounded(file: NwbFile) -> Iterator[Signal]:
    """All signals, counted as they are read. Raises BadRecord: together they are more than any record has."""
    count = numbers = 0
    for room in ROOMS:
        for signal in _series(file, room):
            count, numbers = count + 1, numbers + signal.values.size
            if count > MOST_SIGNALS or numbers > MOST_NUMBERS:
                raise file.bad(f"more than {MOST_SIGNALS} signals or {MOST_NUMBERS} numbers")
            yield signal


def _series(file: NwbFile, room: str, depth: int = 0) -> Iterator[Signal]:
    for child in file.children(room) if depth < DEEPEST else ():
        path = f"{room}/{child}"
        if file.has(f"{path}/data") and file._is_dataset(f"{path}/data"):
            yield from _signals(file, path, child)
        else:
            yield from _series(file, path, depth + 1)


def _signals(file: NwbFile, path: str, name: str) -> Iterator[Signal]:
    """A signal for each column of a series; none where it holds no numbers."""
    data = f"{path}/data"
    if file._dataset(data).get_type().get_class() not in (h5t.INTEGER, h5t.FLOAT):
        return
    values = file.table(data)
    unit = plain(str(file.attribute(data, "unit", "")))
    factor, offset = (file.attribute(data, key, one) for key, one in (("conversion", 1.0), ("offset", 0.0)))
    small = SMALL.get(factor, {}).get(unit, "") if offset == 0 else ""
    if not small and (factor, offset) != (1.0, 0.0):
        values = values * factor + offset
    rate_hz = file.attribute(f"{path}/starting_time", "rate", float("nan"))
    if file.has(f"{path}/timestamps"):
        time_s, events = file.numbers(f"{path}/timestamps"), _uneven(file.numbers(f"{path}/timestamps"))
    elif rate_hz > 0:
        start_s = file.scalar(f"{path}/starting_time")
        time_s, events = float(start_s or 0.0) + np.arange(len(values)) / rate_hz, False
    else:
        raise BadRecord("neither timestamps nor a rate", place=f"{file.name}, {path}", fix="Give the whole file.")
    columns = values.shape[1]
    if columns > MOST_SIGNALS:
        raise file.bad(f"{columns} columns, at most {MOST_SIGNALS} are read", data)
    for index in range(columns):
        called = name if columns == 1 else f"{name}/{index + 1}"
        yield Signal(called, time_s, values[:, index], small or unit, events)


def _uneven(time_s: np.ndarray) -> bool:
    """Whether times are those of events, not of samples: of one step in a hundred, the length is off by half."""
    steps = np.diff(time_s)
    return bool(steps.size and np.mean(np.abs(steps - np.median(steps)) > 0.5 * np.median(steps)) > 0.01)


def _spans(file: NwbFile) -> Iterator[Spans]:
    for child in file.children("/intervals"):
        path = f"/intervals/{child}"
        if not file.has(f"{path}/start_time") or not file.has(f"{path}/stop_time"):
            continue
        starts, ends = file.numbers(f"{path}/start_time"), file.numbers(f"{path}/stop_time")
        texts = [one for one in file.children(path) if file._is_dataset(f"{path}/{one}")
                 and file._dataset(f"{path}/{one}").get_type().get_class() == h5t.STRING]  # fmt: skip
        label = next((one for one in (*LABELS, *texts) if one in texts), None)
        names = file.names(f"{path}/{label}") if label else [child] * starts.size
        if len({starts.size, ends.size, len(names)}) == 1:
            yield Spans(child, tuple(zip(names, starts.tolist(), ends.tolist(), strict=True)))
