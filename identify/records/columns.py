"""Columns of another tool's file: chosen by `--map`, else recognised by name and unit.

A unit is never guessed: a column whose name is known and whose unit is not is refused with the `--map` that would do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from stimrig.identify.errors import BadRecord
from stimrig.identify.records.record import NEEDED, OPTIONAL

_TIME = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "µs": 1e-6, "us": 1e-6, "ns": 1e-9}
_TIME |= {"min": 60.0, "h": 3600.0, "d": 86400.0}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, **dict.fromkeys(("deg", "degree", "degrees", "°"), math.pi / 180)}
_FOOT_POUND_NM = 1.3558179483314004
_FOOT_POUNDS = dict.fromkeys(("lbft", "lbfft", "ftlb", "ftlbf"), _FOOT_POUND_NM)
_INCH_POUNDS = dict.fromkeys(("lbin", "lbfin", "inlb", "inlbf"), _FOOT_POUND_NM / 12)
UNITS: dict[str, dict[str, float]] = {
    "time_s": _TIME,
    "pulse_width_us": {"µs": 1.0, "us": 1.0, "ms": 1e3, "s": 1e6, "ns": 1e-3},
    "torque_nm": {"nm": 1.0, "mnm": 1e-3, "ncm": 1e-2, "nmm": 1e-3, "knm": 1e3, **_FOOT_POUNDS, **_INCH_POUNDS},
    "segment": {},
    "angle_rad": _ANGLE,
    "velocity_rad_s": {f"{unit}/{per}": factor for unit, factor in _ANGLE.items() for per in ("s", "sec")}
    | {"rpm": 2 * math.pi / 60},
    "late_s": _TIME,
    "doubted": {"1": 1.0},
    "pulse_rate_hz": {"hz": 1.0},
}
"""For each column the units that are known, as `plain_unit` writes them, with the factor to the column's own unit."""
COMMON_UNITS = {
    "time_s": ("s", "ms", "µs", "ns", "d"),
    "pulse_width_us": ("µs", "ms", "s"),
    "torque_nm": ("Nm", "mNm", "Ncm"),
    "angle_rad": ("rad", "deg"),
    "velocity_rad_s": ("rad/s", "deg/s", "rpm"),
    "late_s": ("s", "ms", "µs"),
    "doubted": ("1",),
    "pulse_rate_hz": ("Hz",),
}
"""Units that messages offer, the column's own first."""
TARGETS = (*NEEDED, "segment", *OPTIONAL, "pulse_rate_hz")
NAMES = {
    "time_s": "time t timestamp elapsed_time zeit temps tiempo tempo",
    "pulse_width_us": "pulse_width pulsewidth pw pulse_duration pulse_length stim_pw "
    "pulsbreite impulsbreite pulsweite pulsdauer",
    "torque_nm": "torque moment joint_torque elbow_torque drehmoment couple",
    "angle_rad": "angle joint_angle elbow_angle winkel gelenkwinkel",
    "velocity_rad_s": "velocity angular_velocity joint_velocity speed winkelgeschwindigkeit",
    "segment": "segment segments",
    "pulse_rate_hz": "pulse_rate pulse_frequency stim_rate stim_freq stim_frequency stimulation_frequency",
}
"""Names under which other tools write a column, in lower case."""
_KNOWN = {name: target for target, names in NAMES.items() for name in names.split()}
_NO_SIGNS = str.maketrans({"μ": "µ", **dict.fromkeys("·⋅∙*. []()", None)})
_BRACKETS = re.compile(r"^(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\)|/\s*([^\s/]+))\s*$")
MOST_SHOWN = 12
LONGEST_SHOWN = 40
LONGEST_NAME = 100
ColumnMap = Mapping[str, str]
"""What `--map` says, by our column: the name of a column of the file, and its unit after the last colon, if given."""


class Column(NamedTuple):
    """A column of a file: its index, the factor to our unit, and a note on what was assumed."""

    index: int
    factor: float = 1.0
    note: str = ""


def parse_column_map(entries: Mapping[str, str] | Iterable[str] | None) -> ColumnMap:
    """Parse `--map`: a mapping, or texts `target=name` or `target=name:unit`.

    Raises BadRecord: no such target, no name, or one target twice.
    """
    if not isinstance(entries, Mapping):
        texts = [entries] if isinstance(entries, str) else entries or ()
        split = [(text, *text.partition("=")) for text in texts]
        if missing := [text for text, _, equals, _ in split if not equals]:
            fix = "Give TARGET=NAME:UNIT, for instance --map torque_nm=Moment:Nm."
            raise BadRecord(f"{short(missing[0])!r} has no '='", place="--map", fix=fix)
        pairs = [(target.strip(), name) for _, target, _, name in split]
    else:
        pairs = list(entries.items())
    column_map: dict[str, str] = {}
    for target, name in pairs:
        if target not in TARGETS:
            fix = f"Give one of {', '.join(TARGETS)}, for instance --map torque_nm=Moment:Nm."
            raise BadRecord(f"no column is called {short(target)!r}", place="--map", fix=fix)
        if target in column_map:
            raise BadRecord(f"{target} is given twice", place="--map", fix="Give each column once.")
        if not str(name).strip():
            raise BadRecord(f"no name for {target}", place="--map", fix=f"Give --map {target}=NAME:UNIT.")
        column_map[target] = str(name).strip()
    return column_map


def plain_unit(unit: str) -> str:
    """A unit without brackets, dots and capitals: 'N·m', '[Nm]' and 'N*m' are one."""
    return unit.strip().translate(_NO_SIGNS).lower()


def places(header: Sequence[str], column_map: ColumnMap) -> dict[str, list[int]]:
    """Find the cells of a header that may be each column: by `--map`, else by our name, else by a known name."""
    cells = [cell.strip() for cell in header]
    known = [_KNOWN.get(_plain(_split(cell)[0]), "") if len(cell) <= LONGEST_NAME else "" for cell in cells]
    indices_of: dict[str, list[int]] = {}
    for target in TARGETS:
        if target in column_map:
            indices_of[target] = _mapped(cells, target, column_map[target])[0]
        elif not (indices := [index for index, cell in enumerate(cells) if cell == target]):
            indices = [index for index, name in enumerate(known) if name == target]
            with_unit = [index for index in indices if _split(cells[index], target)[1]]
            indices_of[target] = with_unit if len(with_unit) == 1 else indices
        else:
            indices_of[target] = indices
    return {target: indices for target, indices in indices_of.items() if indices}


def columns(header: Sequence[str], column_map: ColumnMap, units_row: Sequence[str], place: str) -> dict[str, Column]:
    """The columns of a header with their units; `units_row` is a row of units below it, empty without one.

    Raises BadRecord: a column is missing, there twice, or of a unit that is unknown; with the `--map` that would
    do. One column is not two things: a torque taken for a pulse width would fit well and mean nothing.
    """
    cells = [cell.strip() for cell in header]
    indices_of = places(cells, column_map)
    if missing := [target for target in (*NEEDED, *column_map) if target not in indices_of]:
        raise _missing(cells, missing, column_map, place)
    columns: dict[str, Column] = {}
    for target, (index, *others) in indices_of.items():
        if others:
            raise _twice(cells[index], cells[others[0]], target, place)
        below = units_row[index].strip() if index < len(units_row) else ""
        if (column := _in_unit(cells, index, target, column_map.get(target), below, place)) is None:
            continue
        if sharing := [other for other, known in columns.items() if known.index == index]:
            message = f"column {short(cells[index])} is asked for twice, as {sharing[0]} and {target}"
            raise BadRecord(message, place=place, fix="Name another column for one of them with --map.")
        columns[target] = column
    return columns


def _in_unit(
    cells: Sequence[str], index: int, target: str, mapped: str | None, below: str, place: str
) -> Column | None:
    """A column with its unit, which stands in `--map`, below the header or in the name; None for an optional column
    without one."""
    cell = cells[index]
    if target == "segment":
        return Column(index, note="" if mapped or (cell == target and not below) else f"segment is {short(cell)!r}")
    wanted, in_name = _mapped(cells, target, mapped)[1] if mapped else "", _split(cell, target)[1]
    factor_of = UNITS[target].get
    if below and in_name and factor_of(plain_unit(below)) != factor_of(plain_unit(in_name)) and not wanted:
        message = f"the name of column {short(cell)!r} says {short(in_name)!r}, the row below it {short(below)!r}"
        raise BadRecord(message, place=place, fix=f"Say which, for instance {_map_text(cell, target)}.")
    written = below or in_name
    unit = wanted or written
    if not unit and cell == target:
        return Column(index)
    if not unit and (mapped or target == "pulse_rate_hz"):
        taken = f"taken in {COMMON_UNITS[target][0]} as no unit is given"
        return Column(index, note=f"{target} is {short(cell)!r}, {taken}")
    if not unit and target not in NEEDED:
        return None
    factor = factor_of(plain_unit(unit))
    if factor is None or (cell == target and not wanted and factor != 1.0):
        raise _unknown_unit(cell, target, unit, place)
    if not wanted:
        return Column(index, factor, "" if cell == target else f"{target} is {short(cell)!r} in {short(unit)}")
    if written and factor_of(plain_unit(written)) not in (None, factor):
        return Column(index, factor, f"{target} is taken in {unit} as --map says; its name says {short(written)}")
    return Column(index, factor)


def _split(cell: str, target: str = "") -> tuple[str, str]:
    """A header's cell as name and unit: 'Torque [mNm]', 'Torque (mNm)', 'Torque / mNm', 'torque_mnm'."""
    if cell == target:
        return cell, ""
    if match := _BRACKETS.match(cell[:LONGEST_NAME]):
        return match[1].strip(), next(text for text in match.groups()[1:] if text is not None).strip()
    for known in (target,) if target else UNITS:
        for unit in sorted(UNITS[known], key=len, reverse=True):
            ending = "_" + unit.replace("/", "_")
            if cell.lower().endswith(ending) and (target or _KNOWN.get(_plain(cell[: -len(ending)])) == known):
                return cell[: -len(ending)], unit
    return cell, ""


def _plain(name: str) -> str:
    return re.sub(r"[\s_\-.]+", "_", name.strip().lower()).strip("_")


def _mapped(cells: Sequence[str], target: str, text: str) -> tuple[list[int], str]:
    """The cells that a `--map` names, and the unit that it gives: by number (#3), by the whole name, else without its
    unit."""
    before, _, behind = text.rpartition(":")
    for name, unit in ((text, ""), (before, behind.strip())):
        if re.fullmatch(r"#\d{1,4}", name) and 0 < int(name[1:]) <= len(cells):
            return [int(name[1:]) - 1], unit
        for names in (cells, [_split(cell, target)[0] for cell in cells]):
            for same in (str, _plain):
                if name and (matches := [index for index, cell in enumerate(names) if same(cell) == same(name)]):
                    return matches, unit
    return [], ""


def _missing(cells: Sequence[str], missing: Sequence[str], column_map: ColumnMap, place: str) -> BadRecord:
    here = ", ".join(short(cell) for cell in cells[:MOST_SHOWN] if cell) + (", …" if len(cells) > MOST_SHOWN else "")
    if target := next((target for target in missing if target in column_map), None):
        return BadRecord(f"no column {short(column_map[target])!r} for {target}", place=place, fix=f"It has: {here}.")
    fix = f"Say which it is, for instance --map {missing[0]}=NAME:{COMMON_UNITS[missing[0]][0]}; it has: {here}."
    if missing[0] == "time_s":
        fix += " Without one, add a column of times: the row's number divided by the sampling rate."
    return BadRecord(f"no column {', '.join(missing)}", place=place, fix=fix)


def _twice(first: str, second: str, target: str, place: str) -> BadRecord:
    if first == second:
        return BadRecord(f"column {short(first)} is there twice", place=place, fix="Keep one of them.")
    fix = f"Say which, for instance --map {target}={short(first)}."
    return BadRecord(f"{target} may be {short(first)!r} or {short(second)!r}", place=place, fix=fix)


def _unknown_unit(cell: str, target: str, unit: str, place: str) -> BadRecord:
    fix = f"Give {_map_text(cell, target)}."
    if target == "torque_nm" and plain_unit(unit) in ("n", "kg", "kn", "v", "mv"):
        fix = "Torque is asked for: multiply by the lever arm or the sensor's scale first."
    reason = f"its unit {short(unit)!r} is not known" if unit else "its unit is not said"
    if plain_unit(unit) in UNITS[target]:
        reason = f"below it stands {short(unit)!r}"
    return BadRecord(f"column {short(cell)!r} is taken for {target}, but {reason}", place=place, fix=fix)


def _map_text(cell: str, target: str) -> str:
    """The `--map` that gives a column its unit, with the units that may be meant."""
    first, *others = COMMON_UNITS[target]
    name = short(_split(cell, target)[0] or cell)
    return f"--map {target}={name}:{first}" + (f" (or {', '.join(others)})" if others else "")


def short(text: str) -> str:
    """A text as messages quote it."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"
