"""Columns of another tool's file: chosen by `--map`, else recognised by name and unit.

A unit is never guessed: a column whose name is known and whose unit is not is refused with the `--map` that would do.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from stimrig.identify.errors import BadRecord
from stimrig.identify.records.record import NEEDED, OPTIONAL

_TIME = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "µs": 1e-6, "us": 1e-6, "min": 60.0}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180}
_ANGLE["°"] = _ANGLE["deg"]
_FOOT_POUND_NM = 1.3558179483314004
_FOOT_POUNDS = dict.fromkeys(("lbft", "lbfft", "ftlb", "ftlbf"), _FOOT_POUND_NM)
_INCH_POUNDS = dict.fromkeys(("lbin", "lbfin", "inlb", "inlbf"), _FOOT_POUND_NM / 12)
UNITS: dict[str, dict[str, float]] = {
    "time_s": _TIME,
    "pulse_width_us": {"µs": 1.0, "us": 1.0, "ms": 1e3, "s": 1e6, "ns": 1e-3},
    "torque_nm": {"nm": 1.0, "mnm": 1e-3, "ncm": 1e-2, "nmm": 1e-3, "knm": 1e3, **_FOOT_POUNDS, **_INCH_POUNDS},
    "angle_rad": _ANGLE,
    "velocity_rad_s": {f"{unit}/{per}": factor for unit, factor in _ANGLE.items() for per in ("s", "sec")}
    | {"rpm": 2 * math.pi / 60},
    "late_s": _TIME,
    "doubted": {"1": 1.0},
    "segment": {},
}
"""For each column the units that are known, as `plain_unit` writes them, with the factor to the column's own unit."""
COMMON_UNITS = {
    "time_s": ("s", "ms", "µs"),
    "pulse_width_us": ("µs", "ms", "s"),
    "torque_nm": ("Nm", "mNm", "Ncm"),
    "angle_rad": ("rad", "deg"),
    "velocity_rad_s": ("rad/s", "deg/s", "rpm"),
    "late_s": ("s", "ms", "µs"),
}
"""Units that messages offer, the column's own first."""
_NO_SIGNS = str.maketrans({"μ": "µ", **dict.fromkeys("·⋅∙*. []()", None)})


def plain_unit(unit: str) -> str:
    """A unit without brackets, dots and capitals: 'N·m', '[Nm]' and 'N*m' are one."""
    return unit.strip().translate(_NO_SIGNS).lower()


def unit_factor(target: str, unit: str) -> float | None:
    """Factor from a unit to the column's own unit; None where the unit is not known."""
    return UNITS[target].get(plain_unit(unit))


TARGETS = (*NEEDED, "segment", *OPTIONAL)
NAMES = {
    "time_s": "time t timestamp elapsed_time zeit temps tiempo tempo",
    "pulse_width_us": "pulse_width pulsewidth pw pulse_duration pulse_length stim_pw "
    "pulsbreite impulsbreite pulsweite pulsdauer",
    "torque_nm": "torque moment joint_torque elbow_torque drehmoment couple",
    "angle_rad": "angle joint_angle elbow_angle winkel gelenkwinkel",
    "velocity_rad_s": "velocity angular_velocity joint_velocity speed winkelgeschwindigkeit",
    "segment": "segment segments",
}
"""Names under which other tools write a column, in lower case."""
_KNOWN = {name: target for target, names in NAMES.items() for name in names.split()}
_BRACKETS = re.compile(r"^(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\)|/\s*([^\s/]+))\s*$")
MOST_SHOWN = 12
LONGEST_SHOWN = 40
LONGEST_NAME = 100


@dataclass(frozen=True)
class ColumnChoice:
    """One `--map` entry: the column's name, and its unit after the last colon, if given."""

    target: str
    text: str

    @property
    def name(self) -> str:
        """The column's name without the unit."""
        return self.text.rpartition(":")[0] if self.unit else self.text

    @property
    def unit(self) -> str:
        """The text after the last colon; empty without one."""
        return self.text.rpartition(":")[2].strip() if ":" in self.text else ""


@dataclass(frozen=True)
class Column:
    """A column of a file: its index, the factor to our unit, and a note on what was assumed."""

    index: int
    factor: float = 1.0
    note: str = ""


ColumnMap = Mapping[str, ColumnChoice]


def parse_column_map(entries: Mapping[str, str] | Iterable[str] | None) -> ColumnMap:
    """Parse `--map` into choices by target: a mapping, or texts `target=name` or `target=name:unit`.

    Raises BadRecord: no such target, no name, or one target twice.
    """
    if entries is None:
        return {}
    entries = [entries] if isinstance(entries, str) else entries
    pairs = list(entries.items()) if isinstance(entries, Mapping) else [_pair(text) for text in entries]
    choices: dict[str, ColumnChoice] = {}
    for target, text in pairs:
        if target not in TARGETS:
            fix = f"Give one of {', '.join(TARGETS)}, for instance --map torque_nm=Moment:Nm."
            raise BadRecord(f"no column is called {short(target)!r}", place="--map", fix=fix)
        if target in choices:
            raise BadRecord(f"{target} is given twice", place="--map", fix="Give each column once.")
        if not str(text).strip():
            raise BadRecord(f"no name for {target}", place="--map", fix=f"Give --map {target}=NAME:UNIT.")
        choices[target] = ColumnChoice(target, str(text).strip())
    return choices


def _pair(text: str) -> tuple[str, str]:
    target, equals, name = text.partition("=")
    if not equals:
        fix = "Give TARGET=NAME:UNIT, for instance --map torque_nm=Moment:Nm."
        raise BadRecord(f"{short(text)!r} has no '='", place="--map", fix=fix)
    return target.strip(), name


def places(header: Sequence[str], column_map: ColumnMap) -> dict[str, list[int]]:
    """Find the cells of a header that may be each column: by `--map`, else by our name, else by a known name."""
    plain = [cell.strip() for cell in header]
    known = [_known_as(cell) for cell in plain]
    indices_of: dict[str, list[int]] = {}
    for target in TARGETS:
        if target in column_map:
            indices_of[target] = _chosen_cells(plain, column_map[target])
        elif not (exact := [index for index, cell in enumerate(plain) if cell == target]):
            named = [index for index, name in enumerate(known) if name == target]
            with_unit = [index for index in named if _split(plain[index], target)[1]]
            indices_of[target] = with_unit if len(with_unit) == 1 else named
        else:
            indices_of[target] = exact
    return {target: indices for target, indices in indices_of.items() if indices}


def complete(indices_of: Mapping[str, list[int]]) -> bool:
    """Return true if a header has all columns that a record needs."""
    return all(target in indices_of for target in NEEDED)


def columns(header: Sequence[str], column_map: ColumnMap, units_row: Sequence[str], place: str) -> dict[str, Column]:
    """The columns of a header with their units; `units_row` is a row of units below it, empty without one.

    Raises BadRecord: a column is missing, there twice, or of a unit that is unknown; with the `--map` that would
    do.
    """
    plain = [cell.strip() for cell in header]
    indices_of = places(plain, column_map)
    missing = [target for target in (*NEEDED, *column_map) if target not in indices_of]
    if missing:
        raise _missing(plain, missing, column_map, place)
    columns: dict[str, Column] = {}
    for target, indices in indices_of.items():
        if len(indices) > 1:
            raise _twice(plain, target, indices, place)
        index = indices[0]
        below = units_row[index].strip() if index < len(units_row) else ""
        if (column := _convert_column(plain[index], target, index, below, column_map.get(target), place)) is not None:
            columns[target] = column
    _refuse_shared(plain, columns, place)
    return columns


def _refuse_shared(cells: Sequence[str], columns: Mapping[str, Column], place: str) -> None:
    """One column cannot be two things: a torque taken for a pulse width would fit well and mean nothing."""
    owner: dict[int, str] = {}
    for target, column in columns.items():
        if column.index in owner:
            message = f"column {short(cells[column.index])} is asked for twice, as {owner[column.index]} and {target}"
            raise BadRecord(message, place=place, fix="Name another column for one of them with --map.")
        owner[column.index] = target


def _convert_column(
    name: str, target: str, index: int, below: str, choice: ColumnChoice | None, place: str
) -> Column | None:
    """Make a column in its unit; None for an optional column without a unit."""
    if target == "segment":
        note = "" if choice or (name == target and not below) else f"segment is column {short(name)!r}"
        return Column(index, note=note)
    wanted = choice.unit if choice is not None and not _is(name, choice.text) else ""
    written = below or _split(name, target)[1]
    unit = wanted or written
    if not unit and name == target:
        return Column(index)
    if not unit and choice is not None:
        default_unit = COMMON_UNITS.get(target, ("1",))[0]
        return Column(index, note=f"{target} is {short(name)!r}, taken in {default_unit} as no unit is given")
    if not unit and target not in NEEDED:
        return None
    factor = unit_factor(target, unit) if unit else None
    if factor is None or (name == target and not wanted and factor != 1.0):
        raise _unit(name, target, unit, place)
    if not wanted:
        return Column(index, factor, "" if name == target else f"{target} is {short(name)!r} in {short(unit)}")
    if written and unit_factor(target, written) not in (None, factor):
        return Column(index, factor, f"{target} is taken in {unit} as --map says; its name says {short(written)}")
    return Column(index, factor)


def _split(cell: str, target: str = "") -> tuple[str, str]:
    """A header's cell as name and unit: 'Torque [mNm]', 'Torque (mNm)', 'Torque / mNm', 'torque_mnm'."""
    if cell == target:
        return cell, ""
    if match := _BRACKETS.match(cell[:LONGEST_NAME]):
        return match[1].strip(), next(text for text in match.groups()[1:] if text is not None).strip()
    for known in (target,) if target else UNITS:
        for tail in sorted(UNITS[known], key=len, reverse=True):
            ending = "_" + tail.replace("/", "_")
            if cell.lower().endswith(ending) and (target or _KNOWN.get(_name(cell[: -len(ending)])) == known):
                return cell[: -len(ending)], tail
    return cell, ""


def _name(text: str) -> str:
    return re.sub(r"[\s_\-.]+", "_", text.strip().lower()).strip("_")


def _known_as(cell: str) -> str:
    """The column that a cell names, by the names that other tools use; empty where none."""
    return _KNOWN.get(_name(_split(cell)[0]), "") if len(cell) <= LONGEST_NAME else ""


def _is(cell: str, name: str) -> bool:
    return cell == name.strip() or _name(cell) == _name(name)


def _chosen_cells(cells: Sequence[str], choice: ColumnChoice) -> list[int]:
    """Find the cells of a `--map` entry: by number (#3), by the whole name, else by the name without its unit."""
    for name in dict.fromkeys((choice.text, choice.name)):
        if re.fullmatch(r"#\d{1,4}", name) and 0 < int(name[1:]) <= len(cells):
            return [int(name[1:]) - 1]
        for same in (cells, [_split(cell, choice.target)[0] for cell in cells]):
            if matches := [index for index, cell in enumerate(same) if cell == name]:
                return matches
            if matches := [index for index, cell in enumerate(same) if _is(cell, name)]:
                return matches
    return []


def _missing(cells: Sequence[str], missing: Sequence[str], column_map: ColumnMap, place: str) -> BadRecord:
    here = ", ".join(short(cell) for cell in cells[:MOST_SHOWN] if cell) + (", …" if len(cells) > MOST_SHOWN else "")
    if choice := next((column_map[target] for target in missing if target in column_map), None):
        return BadRecord(f"no column {short(choice.text)!r} for {choice.target}", place=place, fix=f"It has: {here}.")
    target = missing[0]
    unit = COMMON_UNITS[target][0]
    fix = f"Say which it is, for instance --map {target}=NAME:{unit}; it has: {here}."
    return BadRecord(f"no column {', '.join(missing)}", place=place, fix=fix)


def _twice(cells: Sequence[str], target: str, indices: Sequence[int], place: str) -> BadRecord:
    first, second = (cells[index] for index in indices[:2])
    if first == second:
        return BadRecord(f"column {short(first)} is there twice", place=place, fix="Keep one of them.")
    fix = f"Say which, for instance --map {target}={short(first)}."
    return BadRecord(f"{target} may be {short(first)!r} or {short(second)!r}", place=place, fix=fix)


def _unit(name: str, target: str, unit: str, place: str) -> BadRecord:
    known = COMMON_UNITS.get(target, ("1",))
    column_name = short(_split(name, target)[0] or name)
    fix = f"Give --map {target}={column_name}:{known[0]}" + (f" (or {', '.join(known[1:])})." if known[1:] else ".")
    if target == "torque_nm" and plain_unit(unit) in ("n", "kg", "kn", "v", "mv"):
        fix = "Torque is asked for: multiply by the lever arm or the sensor's scale first."
    reason = f"its unit {short(unit)!r} is not known" if unit else "its unit is not said"
    if unit and unit_factor(target, unit) is not None:
        reason = f"below it stands {short(unit)!r}"
    return BadRecord(f"column {short(name)!r} is taken for {target}, but {reason}", place=place, fix=fix)


def short(text: str) -> str:
    """A text as messages quote it."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"
