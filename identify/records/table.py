"""A table as it was read from a file, and checks that a measurement can have given its numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stimrig.identify.errors import BadRecord
from stimrig.identify.records import bounds
from stimrig.identify.records.columns import Column
from stimrig.identify.records.record import Part, Record, Source

LEAST_LARGEST_US = 1.0
"""A record whose largest pulse width is less has it in another unit."""
MOST_HOLES = 0.1
"""Share of rows without a number up to which the others are a record."""
LEAST_JUMPS, LESS = 3, 0.5
"""So many steps between whole and decimal numbers, most of which shrink as much if the points separate thousands."""
LEAST_ALONE = 8
"""From so many widths on, each between two zeros, a record seems to have them in the samples of its pulses only."""
DEGREES = "No joint turns so far. If these are degrees, say so: --map angle_rad=angle_rad:deg, the velocity alike."


@dataclass(frozen=True)
class Table:
    """Columns of a file."""

    columns: dict[str, np.ndarray]
    """In our units, by our names, each of shape (N,); NaN where the file has no number. A `segment`, where it has one,
    is an index into `segment_names` for each row."""
    segment_names: Sequence[str]
    name: str  # how messages call the file
    cell: Callable[[int, str], str]  # how messages call a cell in it, by row and column
    source: Source  # the file, with notes on how it was read
    pulse_rate_hz: float = 40.0  # pulses a second
    part_cells: Mapping[int, Mapping[str, str]] = field(default_factory=dict)
    """Of a joined record: the cells that describe a part, by the row that it begins with."""

    @classmethod
    def of(
        cls,
        content: bytes,
        path: Path,
        known: Mapping[str, Column],
        numbers: Mapping[str, np.ndarray],
        segment_names: Sequence[str],
        cell: Callable[[int, str], str],
        notes: Sequence[str] = (),
        part_cells: Mapping[int, Mapping[str, str]] | None = None,
    ) -> Table:
        """The table of a file whose `known` columns have these `numbers`, each in the file's own unit.

        Raises BadRecord: more than one pulse rate, or an impossible one; points between thousands.
        """
        notes = (*notes, "; ".join(column.note for column in known.values() if column.note))
        source = Source(path.name, sha256=hashlib.sha256(content).hexdigest(), notes=tuple(filter(None, notes)))
        scaled = {name: column * known[name].factor for name, column in numbers.items() if name != "segment"}
        scaled |= {"segment": numbers["segment"]} if "segment" in numbers else {}
        rates_hz = np.unique(scaled.pop("pulse_rate_hz", np.array([])))
        rates_hz = rates_hz[~np.isnan(rates_hz)]
        rates_hz = rates_hz[rates_hz > 0] if np.any(rates_hz > 0) else rates_hz  # 0 while nothing is stimulated
        if rates_hz.size > 1:
            raise BadRecord("different pulse rates", place=f"{path}, pulse_rate_hz", fix="Give a record of one rate.")
        for rate_hz in rates_hz:
            bounds.check_rate(rate_hz, f"{path}, pulse_rate_hz")
        rate_hz = float(rates_hz[0]) if rates_hz.size else cls.pulse_rate_hz
        table = cls(scaled, segment_names, str(path), cell, source, rate_hz, part_cells or {})
        for name in ("pulse_width_us", "torque_nm"):
            if row := _first_thousand(numbers[name]):
                message = f"{numbers[name][row]:g} among whole numbers of some hundreds"
                fix = "If points separate thousands, write numbers without signs between thousands."
                raise table.bad(message, fix, row, name)
        return table

    def at(self, row: int, column: str = "time_s") -> str:
        """Name a cell, with the file, in messages."""
        return f"{self.name}, {self.cell(row, column)}"

    def bad(self, message: str, fix: str, row: int, column: str = "time_s") -> BadRecord:
        """The error at a cell."""
        return BadRecord(message, place=self.at(row, column), fix=fix)

    def noting(self, *notes: str, columns: dict[str, np.ndarray] | None = None) -> Table:
        """The same with other columns, and with more to say."""
        source = replace(self.source, notes=(*self.source.notes, *(note for note in notes if note)))
        return replace(self, source=source, columns=self.columns | (columns or {}))

    def record(self, parts: Sequence[Part] = (Part(),)) -> Record:
        """The columns as a record, as they are."""
        low_us = float(np.min(self.columns["pulse_width_us"], initial=np.inf))
        return Record.from_arrays(
            **self.columns,  # type: ignore
            segment_names=self.segment_names,
            pulse_rate_hz=self.pulse_rate_hz,
            source=self.noting(f"the lowest width, {low_us:.4g} µs, is taken as rest" if low_us > 0 else "").source,
            parts=parts,
        )


def checked(table: Table) -> Table:
    """Without the rows that lack a number, which are gaps like any other; times of a calendar from the first sample.

    Raises BadRecord: infinite, or beyond what is measured; too many rows lack a number; a record of days.
    """
    for name, values in table.columns.items():
        largest = bounds.LARGEST | {"time_s": bounds.LARGEST_CALENDAR_S, "segment": np.inf}
        wrong = ~(np.abs(values) <= largest[name]) & ~(np.isnan(values) & (name in bounds.MAY_LACK))
        wrong |= (name == "doubted") & (values != 0) & (values != 1)
        if wrong.any():
            row = int(np.argmax(wrong))
            message = "no number" if np.isnan(values[row]) else f"{values[row]:g} is no measurement"
            fix = "Remove the row's cause, or cut the record before it; values must be finite."
            fix = DEGREES if name == "angle_rad" and np.isfinite(values[wrong]).all() else fix
            fix = "1 is a row in which it is not known what was felt, 0 any other." if name == "doubted" else fix
            raise table.bad(message, fix, row, name)
    table = _without_holes(table)
    _check_widths(table)
    time_s = table.columns["time_s"]
    if np.max(np.abs(time_s), initial=0.0) > bounds.LARGEST["time_s"]:
        note = f"time is counted from the first sample, at {time_s[0]:.3f} s"
        table = table.noting(note, columns={"time_s": time_s - time_s[0]})
    bounds.check_span(time_s, table.at(time_s.size - 1))
    return table


def _first_thousand(values: np.ndarray) -> int:
    """First row with a number whose decimal point seems to separate thousands (999, 1.001); 0 for none."""
    is_whole = values == np.rint(values)
    decimals = values[~is_whole & ~np.isnan(values)]
    if not decimals.size or np.any(np.abs(1e3 * decimals - np.rint(1e3 * decimals)) > 1e-6):
        return 0
    ends = np.flatnonzero(is_whole[1:] != is_whole[:-1])
    whole = np.where(is_whole[ends], values[ends], values[ends + 1])
    decimal = np.where(is_whole[ends], values[ends + 1], values[ends])
    shrinks = np.abs(1e3 * decimal - whole) < LESS * np.abs(decimal - whole)
    many = np.sum(shrinks) >= max(LEAST_JUMPS, 0.5 * ends.size)
    return int(np.argmax(~is_whole)) if many and np.all(np.abs(values[is_whole]) < 1e3) else 0


def _without_holes(table: Table) -> Table:
    holes = {name: np.isnan(column) for name, column in table.columns.items()}
    is_hole = np.logical_or.reduce(list(holes.values()))
    count = int(np.count_nonzero(is_hole))
    if not count:
        return table
    first = int(np.argmax(is_hole))
    column = next(name for name, missing in holes.items() if missing[first])
    share = 0.0 if table.part_cells else MOST_HOLES
    if count > share * is_hole.size:
        message = f"no number here, nor in {count - 1} of {is_hole.size} rows" if count > 1 else "no number"
        fix = f"At most {100 * share:.0f} % of the rows may lack one."
        if column == "pulse_width_us":
            fix += " Fill the width down: each row needs the width in force."
        raise table.bad(message, fix, first, column)
    rows = np.flatnonzero(~is_hole)
    times = "1 row is" if count == 1 else f"{count} rows are"
    note = f"{times} left out for want of a number (first at {table.cell(first, column)})"
    without = table.noting(note, columns={name: values[rows] for name, values in table.columns.items()})
    return replace(without, cell=lambda row, column: table.cell(int(rows[row]), column))


def _check_widths(table: Table) -> None:
    """Refuse negative widths, and widths in another unit or in the samples of pulses only."""
    width_us = table.columns["pulse_width_us"]
    largest_us = float(np.max(width_us, initial=0.0))
    if (negative := np.flatnonzero(width_us < 0)).size:
        fix, row = "A pulse width is 0 (no pulse) or positive.", int(negative[0])
        raise table.bad(f"{width_us[row]:g} µs is negative", fix, row, "pulse_width_us")
    if 0.0 < largest_us < LEAST_LARGEST_US:
        message = f"the largest is {largest_us:g} µs, and no stimulator gives so little"
        fix = "Give µs: multiply seconds by 1000000, milliseconds by 1000; or say the unit, for instance --map "
        raise table.bad(message, f"{fix}pulse_width_us=pulse_width_us:s.", int(width_us.argmax()), "pulse_width_us")
    pulses = np.flatnonzero(width_us)
    step_s = float(np.median(np.diff(table.columns["time_s"]))) if pulses.size > LEAST_ALONE else np.inf
    if step_s * table.pulse_rate_hz < 0.6 and np.all(np.diff(pulses) > 1):
        message = "widths stand only in the samples of the pulses"
        raise table.bad(message, "Hold each width until the next pulse.", int(pulses[0]), "pulse_width_us")
