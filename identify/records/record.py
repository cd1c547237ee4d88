"""A record: what was applied and what was measured, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.summary import Sheet, Summarised, quantity

if TYPE_CHECKING:
    from stimrig.identify.records.joint_motion import JointMotion

HELD_OUT = "validate"
"""Rows of this segment are never used to fit or to choose an effect; they may only speak against one. Another case, or
blanks around it, make no other segment."""
NEEDED = ("time_s", "pulse_width_us", "torque_nm")
OPTIONAL = ("angle_rad", "velocity_rad_s", "late_s", "doubted")
"""Every column that a record may have or not: what cuts, joins or copies records goes by these lists and loses none."""
FORGOTTEN_S = 1.5
"""So long after something unknown was applied a muscle still shows it: 7 time constants of 0.2 s, a slow muscle's."""


@dataclass(frozen=True)
class Source:
    """Where a record came from, so that a model can say what it was fitted on; `parts` of a joined one, in order.

    `notes` are sentences on what was assumed when it was read: each changes what the numbers mean.
    """

    name: str = ""
    recording_id: str = ""
    sha256: str = ""
    parts: tuple[Source, ...] = ()
    notes: tuple[str, ...] = ()
    participant: str = ""
    """Participant named in a sealed recording; empty for other files."""
    current_ma: float | None = None
    """With what current it was made, as a sealed recording says; None where the file does not say."""


def joined_source(parts: Sequence[Source], name: str = "joined", sha256: str = "") -> Source:
    """Where a joined record comes from: the ids of its parts' recordings, or their names where they have none.

    `sha256` is that of the file it is read from; without one, those of the parts stand for it.
    """
    identity = " + ".join(part.recording_id or part.name for part in parts)
    return Source(name, identity, sha256 or " + ".join(part.sha256 for part in parts), tuple(parts))


@dataclass(frozen=True)
class Part:
    """One of the recordings that a record is made of."""

    first: int = 0  # index of its first sample in the record
    own_s: float = 0.0  # time of that sample on the part's own clock, s
    begun_s: float | None = None  # when that clock was 0, as Unix time, where it is known
    pause_s: float = 0.0
    """The true pause before it, s, in whole pulse intervals; at most a day; 0 before the first, and where not known."""
    folded_s: float = 0.0  # what of that pause there is in `time_s`, s, in whole pulse intervals; at most `pause_s`


@dataclass(frozen=True)
class Pulses:
    """The pulses themselves, for the times at which a record has no samples."""

    time_s: np.ndarray  # shape (P,); even slot of each, s, rising
    width_us: np.ndarray  # shape (P,); width felt, µs; 0 where there was none
    late_s: np.ndarray  # shape (P,); by how much later than its slot it was felt, s
    lost: np.ndarray  # shape (P,); planned, and not sent


@dataclass(frozen=True, repr=False)
class Record(Summarised):
    """Pulse widths applied and torque measured, uniformly sampled."""

    time_s: np.ndarray  # shape (N,); sample times, s, strictly increasing and uniform
    pulse_width_us: np.ndarray  # shape (N,); pulse width in force at each sample, µs, held between pulses
    torque_nm: np.ndarray  # shape (N,); measured torque, N·m
    segment: np.ndarray  # shape (N,); index into `segment_names` for each sample
    segment_names: tuple[str, ...]  # one name for each contiguous run of rows; a name may occur several times
    angle_rad: np.ndarray | None = None  # of the joint, shape (N,)
    velocity_rad_s: np.ndarray | None = None
    """Shape (N,); joint angle, rad, and angular velocity, rad/s, as they were recorded: `motion` is what is reckoned
    with."""
    late_s: np.ndarray | None = None
    """Shape (N,); by how much later than its even slot the pulse in force was felt, s; may be slightly negative."""
    doubted: np.ndarray | None = None
    """Shape (N,); samples in which it is not known what was felt: never used to fit or to choose, and the error there
    not counted."""
    pulses: Pulses | None = None  # what was applied while there were no samples, where it is known
    pulse_rate_hz: float = 40.0  # pulses a second
    source: Source = field(default_factory=Source)  # origin
    parts: tuple[Part, ...] = (Part(),)  # the recordings it is made of, in order; one, except for a joined record

    @classmethod
    def from_arrays(
        cls,
        time_s: np.ndarray,
        pulse_width_us: np.ndarray,
        torque_nm: np.ndarray,
        segment: np.ndarray | list[str] | None = None,
        *,
        segment_names: Sequence[str] | None = None,
        angle_rad: np.ndarray | None = None,
        velocity_rad_s: np.ndarray | None = None,
        late_s: np.ndarray | None = None,
        doubted: np.ndarray | None = None,
        pulses: Pulses | None = None,
        pulse_rate_hz: float = 40.0,
        source: Source | None = None,
        parts: Sequence[Part] = (Part(),),
    ) -> Record:
        """Build a record from arrays; `segment` gives a name for each row (default: all `prbs`).

        With `segment_names`, `segment` gives an index into them for each row: a million rows need not hold a million
        names.

        Raises BadRecord: lengths differ, there is nothing, or an optional column is not finite.

        Parameters
        ----------
        time_s : ndarray
            Rising times, s, shape (N,).
        pulse_width_us : ndarray
            Width held since the last pulse, µs, shape (N,).
        torque_nm : ndarray
            Torque, N·m, shape (N,).
        segment : sequence of str, optional
            Name of the segment of each row, or its index.
        segment_names : sequence of str, optional
            Names, where `segment` holds indices.
        angle_rad : ndarray, optional
            Angle of the joint, rad, shape (N,).
        velocity_rad_s : ndarray, optional
            Its velocity, rad/s, shape (N,).
        late_s : ndarray, optional
            How much later than planned the pulse of each row came, s, shape (N,).
        doubted : ndarray, optional
            Rows where it is not known which pulses acted, bool, shape (N,).
        pulses : Pulses, optional
            Pulses as the device confirmed them.
        pulse_rate_hz : float
            Pulses a second, Hz.
        source : Source, optional
            Where the record comes from.
        parts : sequence of Part
            Of a joined record.
        """
        time_s = np.ascontiguousarray(time_s, float)
        size = time_s.size
        code, known, note = _coded(size, segment, segment_names)
        source = source or Source()
        optional = dict(zip(OPTIONAL, (angle_rad, velocity_rad_s, late_s, doubted), strict=True))
        given = {"pulse_width_us": pulse_width_us, "torque_nm": torque_nm, "segment": code, **optional}
        for label, column in given.items():
            if column is not None and np.shape(column) != (size,):
                raise BadRecord(f"{label} has shape {np.shape(column)}, time_s has ({size},)", place=label)
        if size == 0:
            raise BadRecord("the record holds no sample", fix="Give at least a few seconds of data.")
        changed = np.r_[True, code[1:] != code[:-1]]
        changed[[part.first for part in parts]] = True
        return cls(
            time_s=time_s,
            pulse_width_us=np.ascontiguousarray(pulse_width_us, float),
            torque_nm=np.ascontiguousarray(torque_nm, float),
            segment=np.cumsum(changed) - 1,
            segment_names=tuple(known[index] for index in code[changed]),
            pulses=pulses,
            pulse_rate_hz=pulse_rate_hz,
            source=replace(source, notes=(*source.notes, note)) if note else source,
            parts=tuple(parts),
            **{label: _checked(label, column) for label, column in optional.items() if column is not None},
        )

    def _sheet(self) -> Sheet:
        sizes = np.bincount(self.segment, minlength=len(self.segment_names)) / self.sample_rate_hz
        played = [f"{name} {quantity(float(s), 's')}" for name, s in zip(self.segment_names, sizes, strict=True)]
        unseen_s = float(np.sum(self.held_out)) / self.sample_rate_hz
        widths = np.unique(self.pulse_width_us)
        rows = [
            ("segments", ", ".join(played)),
            ("held out", quantity(unseen_s, "s") if unseen_s else f"no rows of `{HELD_OUT}`"),
            ("widths", f"{_from_to(self.pulse_width_us, 'µs')}, {widths.size} different"),
            ("torque", _from_to(self.torque_nm, "N·m")),
        ]
        if self.columns():
            rows.append(("more", ", ".join(self.columns())))
        rows += [("note", note) for note in self.notes]
        rates = f"{quantity(self.sample_rate_hz, 'samples/s')}, {quantity(self.pulse_rate_hz, 'pulses/s')}"
        long = quantity(self.time_s.size / self.sample_rate_hz, "s")
        return Sheet(f"Record {self.source.name or 'without a name'}: {long}, {rates}", tuple(rows))

    def columns(self) -> dict[str, np.ndarray]:
        """The optional columns that this record has, by name."""
        return {name: column for name in OPTIONAL if (column := getattr(self, name)) is not None}

    def samples(self) -> dict[str, np.ndarray]:
        """Times, pulse widths, torques and the optional columns, by name."""
        return {name: getattr(self, name) for name in NEEDED} | self.columns()

    def take(self, rows: np.ndarray) -> Record:
        """The record of some of its rows (bool or indices, rising), with every column it has, and its pulses."""
        return Record.from_arrays(
            **{name: column[rows] for name, column in self.samples().items()},
            segment=self.segment[rows],
            segment_names=self.segment_names,
            pulses=self.pulses,
            pulse_rate_hz=self.pulse_rate_hz,
            source=self.source,
            parts=self._parts_of(np.arange(self.time_s.size)[rows]),
        )

    def _parts_of(self, kept_rows: np.ndarray) -> list[Part]:
        """The parts of some of its rows; one that goes as a whole is a pause."""
        first = np.searchsorted(kept_rows, [part.first for part in self.parts])
        parts: list[Part] = []
        pause_s = folded_s = 0.0
        for part, start, end in zip(self.parts, first, [*first[1:], kept_rows.size], strict=True):
            pause_s, folded_s = pause_s + part.pause_s, folded_s + part.folded_s
            if start < end:
                moved_s = float(self.time_s[kept_rows[start]] - self.time_s[part.first])
                before = (pause_s, folded_s) if parts else (0.0, 0.0)
                parts.append(Part(int(start), part.own_s + moved_s, part.begun_s, *before))
                pause_s = folded_s = 0.0
        return parts or [Part()]

    @cached_property
    def sample_rate_hz(self) -> float:
        """Samples a second, gaps and pauses aside."""
        if self.time_s.size < 2:
            return self.pulse_rate_hz
        steps = np.diff(self.time_s)
        steps = steps[steps < 1.5 * np.median(steps)]
        return steps.size / float(np.sum(steps))

    @cached_property
    def motion(self) -> JointMotion | None:
        """Motion of the joint from the angles alone, each part smoothed by itself; None without an angle."""
        if self.angle_rad is None:
            return None
        from stimrig.identify.records.joint_motion import JointMotion  # here, so that reading a file imports no numba

        return JointMotion.of(self.time_s, self.angle_rad, [part.first for part in self.parts])

    def knows(self, name: str) -> bool:
        """Return true if the record has an optional column; the velocity of the joint follows from its angle."""
        return getattr(self, name) is not None or (name == "velocity_rad_s" and self.angle_rad is not None)

    @cached_property
    def held_out(self) -> np.ndarray:
        """bool, shape (N,): rows that are never used to fit or to choose."""
        flags = np.array([name == HELD_OUT for name in self.segment_names])
        return flags[self.segment]

    @cached_property
    def part(self) -> np.ndarray:
        """int, shape (N,): index into `parts` for each sample."""
        first = [part.first for part in self.parts]
        return np.searchsorted(first, np.arange(self.time_s.size), side="right") - 1

    @property
    def sources(self) -> tuple[Source, ...]:
        """Where each of its parts came from."""
        known = self.source.parts
        return known if len(known) == len(self.parts) else (replace(self.source, parts=()),) * len(self.parts)

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions made in reading, in sentences; with the part's name where it is one of several."""
        of_parts = (f"{part.name}: {note}" for part in self.source.parts for note in part.notes)
        return tuple(dict.fromkeys((*self.source.notes, *of_parts)))

    def with_torque(self, torque_nm: np.ndarray) -> Record:
        """The same record with another torque, N·m, shape (N,)."""
        return replace(self, torque_nm=np.ascontiguousarray(torque_nm, float))


def _checked(label: str, column: np.ndarray) -> np.ndarray:
    """An optional column, finite; `doubted` as bool."""
    values = np.ascontiguousarray(column, float)
    is_flag = label == "doubted"
    if (bad := np.flatnonzero((values != 0) & (values != 1) if is_flag else ~np.isfinite(values))).size:
        message, fix = "not finite", "Leave the column out."
        if is_flag:
            message, fix = f"{values[bad[0]]:g} is neither 0 nor 1", "1 is doubted, 0 is not."
        raise BadRecord(message, place=f"{label}, sample {int(bad[0])}", fix=fix)
    return values > 0 if is_flag else values


def _coded(
    size: int, segment: np.ndarray | list[str] | None, names: Sequence[str] | None
) -> tuple[np.ndarray, list[str], str]:
    """A number for each row's segment, the same for the same name; the names by number; what to say of them."""
    if segment is None:
        return np.zeros(size, np.int64), ["prbs"], ""
    if names is None:
        unique, code = np.unique(np.asarray(segment, dtype=str), return_inverse=True)
        names, segment = [str(name) for name in unique], code.reshape(np.shape(segment))
    known = [HELD_OUT if name.strip().lower() == HELD_OUT else str(name) for name in names]
    first = {name: index for index, name in reversed(list(enumerate(known)))}
    same = np.array([first[name] for name in known], np.int64)
    other = dict.fromkeys(name for name, canonical in zip(names, known, strict=True) if name != canonical)
    note = f"segment {', '.join(map(repr, other))} is taken as {HELD_OUT}" if other else ""
    return same[np.asarray(segment, np.int64)], known, note


def _from_to(values: np.ndarray, unit: str) -> str:
    return f"{quantity(float(values.min()), unit)} to {quantity(float(values.max()), unit)}"
