"""A record of several muscles at one joint: one torque, and for each channel its own pulse widths."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from stimrig.identify.dynamics.grid import Grid, make_grid
from stimrig.identify.errors import BadRecord
from stimrig.identify.records import HDF5_MAGIC, bounds
from stimrig.identify.records.clock import pulse_phase_s
from stimrig.identify.records.record import Record

NAME = r"[a-z][a-z0-9_-]{0,31}"
"""What a channel may be called."""
RESERVED = ("joint", "predicted")
"""What a channel may not be called: files say it of the joint, and of a prediction."""
_COLUMN = re.compile(rf"(?P<name>{NAME})_pulse_width_us")
HEAD_BYTES = 4096
"""Of a table, in which its header stands."""
MOST = 8
"""Channels of a stimulator."""
HAIR_S = 1e-6
"""Times that lie so close together are the same."""


@dataclass(frozen=True)
class Channel:
    """One output of the stimulator, with its electrodes."""

    name: str  # of the channel
    muscle: str = ""  # as "biceps brachii"
    side: str = ""  # "left" or "right"
    electrode: str = ""  # where it lies
    offset_s: float = 0.0  # by how much later than those of the first channel its pulses come, s

    def to_dict(self) -> dict[str, str | float]:
        """As the files tell it.

        Returns
        -------
        dict
        """
        return dict(vars(self))


@dataclass(frozen=True)
class JointRecord:
    """One record for each channel; all have the same times, torque and segments.

    The widths of a channel stand on the slots of the first one: `Channel.offset_s` says how much later they come.
    """

    channels: tuple[Channel, ...]  # what is known of each
    records: tuple[Record, ...]  # one for each channel

    @classmethod
    def from_arrays(
        cls,
        channels: Sequence[Channel],
        time_s: np.ndarray,
        pulse_width_us: Mapping[str, np.ndarray],
        torque_nm: np.ndarray,
        segment: np.ndarray | list[str] | None = None,
        pulse_rate_hz: float = 40.0,
    ) -> JointRecord:
        """Build it from arrays, shape (N,); `pulse_width_us`: by the channel's name, held from its pulse on, µs.

        Raises BadRecord: as `Record.from_arrays`, or a channel without widths.

        Parameters
        ----------
        channels : sequence of Channel
            What is known of each.
        time_s : ndarray
            Rising times, s, shape (N,).
        pulse_width_us : mapping
            By the channel's name, µs, shape (N,).
        torque_nm : ndarray
            Torque of the joint, N·m, shape (N,).
        segment : sequence of str, optional
            Name of the segment of each row.
        pulse_rate_hz : float
            Pulses a second of each channel, Hz.

        Returns
        -------
        JointRecord
        """
        records = []
        for channel in channels:
            if channel.name not in pulse_width_us:
                raise BadRecord(f"no pulse widths of {channel.name}", place=channel.name, fix="Give a column for it.")
            given_us = np.asarray(pulse_width_us[channel.name])
            width_us = held_later(np.asarray(time_s, float), given_us, -channel.offset_s)
            records.append(Record.from_arrays(time_s, width_us, torque_nm, segment, pulse_rate_hz=pulse_rate_hz))
        return cls(tuple(channels), tuple(records))

    def __post_init__(self) -> None:
        names = self.names
        if not 2 <= len(names) <= MOST or len(set(names)) < len(names):
            fix = f"Give 2 to {MOST} channels of different names."
            raise BadRecord(f"channels {', '.join(names) or 'none'}", place="channels", fix=fix)
        for name in names:
            if not re.fullmatch(NAME, name):
                raise BadRecord(f"{name!r} is no name", place="channels", fix="Use small letters, digits, _ and -.")
        if any(record.time_s.size != self.torque_nm.size for record in self.records):
            raise BadRecord("the channels differ in length", place="channels")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the channels, in order."""
        return tuple(channel.name for channel in self.channels)

    @property
    def time_s(self) -> np.ndarray:
        """Times of the samples, s, shape (N,)."""
        return self.records[0].time_s

    @property
    def torque_nm(self) -> np.ndarray:
        """Measured torque of the joint, N·m, shape (N,)."""
        return self.records[0].torque_nm

    @property
    def held_out(self) -> np.ndarray:
        """bool, shape (N,): samples of `validate`."""
        return self.records[0].held_out

    @cached_property
    def grids(self) -> tuple[Grid, ...]:
        """The record on the slots of the first channel, once for each channel; all have the same rows."""
        first = self.records[0]
        active = next((one for one in self.records if np.ptp(one.pulse_width_us) > 0), first)
        phase_s = pulse_phase_s(active)
        grids = [make_grid(record, phase_s) for record in self.records]
        doubted = np.any([grid.doubted for grid in grids], axis=0)
        resumed = np.unique(np.concatenate([grid.resumed for grid in grids]))
        alike = {"doubted": doubted, "resumed": resumed}
        return tuple(
            replace(grid, offset_s=channel.offset_s, **alike)
            for grid, channel in zip(grids, self.channels, strict=True)
        )

    def with_torque(self, torque_nm: np.ndarray) -> JointRecord:
        """The same with another torque, N·m, shape (N,).

        Parameters
        ----------
        torque_nm : ndarray
            Torque, N·m, shape (N,).

        Returns
        -------
        JointRecord
        """
        return replace(self, records=tuple(record.with_torque(torque_nm) for record in self.records))

    def take(self, rows: np.ndarray) -> JointRecord:
        """Some of its rows.

        Parameters
        ----------
        rows : ndarray
            Of the record: bool of shape (N,), or rising indices.

        Returns
        -------
        JointRecord
        """
        return replace(self, records=tuple(record.take(rows) for record in self.records))

    def moving(self, memory_s: float = 1.0) -> dict[str, np.ndarray]:
        """bool, shape (N,), by channel: samples up to `memory_s` after a pulse of it.

        Parameters
        ----------
        memory_s : float
            How long a pulse acts, s.

        Returns
        -------
        dict
        """
        reach = max(round(memory_s * self.records[0].sample_rate_hz), 1)
        found = {}
        for channel, record in zip(self.channels, self.records, strict=True):
            last = np.maximum.accumulate(np.where(record.pulse_width_us > 0, np.arange(record.time_s.size), -reach - 1))
            found[channel.name] = np.arange(record.time_s.size) - last <= reach
        return found


def held_later(time_s: np.ndarray, width_us: np.ndarray, later_s: float) -> np.ndarray:
    """Widths, shape (N,), as they are held if their pulses come so much later, or earlier; 0 before the first.

    Parameters
    ----------
    time_s : ndarray
        Of the samples, s, shape (N,).
    width_us : ndarray
        As held, µs, shape (N,).
    later_s : float
        So much later, s.

    Returns
    -------
    ndarray
    """
    if later_s == 0.0:
        return width_us
    last = np.searchsorted(time_s, time_s - later_s + HAIR_S, side="right") - 1
    return np.where(last < 0, 0.0, width_us[np.maximum(last, 0)])


def is_joint(path: str | Path) -> bool:
    """Whether a file holds the pulses of several channels; a pipe, which can be read once, does not.

    Raises BadRecord: it cannot be read.

    Parameters
    ----------
    path : path
        Of the file.

    Returns
    -------
    bool
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        return False
    with bounds.opened(path) as file:
        head = file.read(HEAD_BYTES)
    if head.startswith(HDF5_MAGIC):
        from stimrig.identify.records.recording import channels_of

        return len(channels_of(bounds.content_of(path), path)) > 1
    return len(_columns(head)) > 1


def _columns(content: bytes) -> list[str]:
    """The channels of a table's header; empty where it names none."""
    for line in content[:HEAD_BYTES].decode("utf-8", "replace").splitlines():
        if found := _COLUMN.findall(line):
            return list(dict.fromkeys(found))
    return []


def read(path: str | Path, pulse_rate_hz: float | None = None) -> JointRecord:
    """Read a sealed recording of several channels, or a table with a column `<name>_pulse_width_us` for each.

    In a table the changes of width tell how much later a channel's pulses come.

    Raises BadRecord: as `stimrig.identify.read`, or the file holds one channel.

    Parameters
    ----------
    path : path
        Of the file.
    pulse_rate_hz : float, optional
        Pulses a second, Hz; default: as the file says.

    Returns
    -------
    JointRecord
    """
    from stimrig.identify.records import read as read_one

    path = Path(path)
    content = bounds.content_of(path)
    if content.startswith(HDF5_MAGIC):
        from stimrig.identify.records.recording import channels_of, read_recording

        told = channels_of(content, path)
        if len(told) > 1:
            known = [Channel(**{name: one[name] for name in vars(Channel("")) if name in one}) for one in told]
            records = [read_recording(content, path, pulse_rate_hz, place) for place in range(len(told))]
            return JointRecord(tuple(known), tuple(records))
        names: list[str] = []
    else:
        names = _columns(content)
    if taken := set(names) & set(RESERVED):
        raise BadRecord(f"a channel called {taken.pop()}", place=path.name, fix="Give its column another name.")
    if len(names) > MOST:
        raise BadRecord(f"pulses of {len(names)} channels", place=path.name, fix=f"Give at most {MOST}.")
    if len(names) < 2:
        fix = "It needs two columns such as biceps_pulse_width_us and triceps_pulse_width_us."
        raise BadRecord("the file holds the pulses of one channel", place=path.name, fix=fix)
    records = [_of_table(read_one, path, pulse_rate_hz, name) for name in names]
    offsets_s = _offsets(records)
    shifted = [
        replace(record, pulse_width_us=held_later(record.time_s, record.pulse_width_us, -offset_s))
        for record, offset_s in zip(records, offsets_s, strict=True)
    ]
    channels = [Channel(name, offset_s=offset_s) for name, offset_s in zip(names, offsets_s, strict=True)]
    return JointRecord(tuple(channels), tuple(shifted))


def _of_table(read_one: Callable[..., Record], path: Path, pulse_rate_hz: float | None, name: str) -> Record:
    """One channel of a table; that its column is the width is no assumption."""
    column = f"{name}_pulse_width_us"
    record = read_one(path, pulse_rate_hz, {"pulse_width_us": column})
    notes = tuple(note for note in record.source.notes if column not in note)
    return replace(record, source=replace(record.source, notes=notes))


def _offsets(records: Iterable[Record]) -> list[float]:
    """By how much later than those of the first each record's pulses come, s, less than an interval."""
    own = [(pulse_phase_s(record), 1.0 / record.pulse_rate_hz, 1.0 / record.sample_rate_hz) for record in records]
    first_s = own[0][0]
    found = []
    for phase_s, step_s, sample_s in own:
        offset_s = float(np.mod(phase_s - first_s + 0.5 * sample_s, step_s)) - 0.5 * sample_s
        found.append(0.0 if abs(offset_s) < 0.75 * sample_s else offset_s)
    return found
