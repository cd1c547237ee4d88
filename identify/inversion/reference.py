"""The torque that is wanted, checked and brought onto the pulses; and read from a table of text.

The table is `time_s,torque_nm`, or `torque_nm` alone with one row for each pulse; of a joint that moves `angle_rad`
beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.errors import BadRecord, BadRequest
from stimrig.identify.problem.pulses import motion_of
from stimrig.identify.records.cells import is_number
from stimrig.identify.records.csv import COMMENTS, encoding_of, text_lines
from stimrig.identify.records.joint_motion import JointMotion

LONGEST_S = 300.0
MOST_SAMPLES = 60_000
"""Samples of the longest reference, at 200 a second."""
LARGEST_NM = 1000.0
LARGEST_RAD = 7.0
"""A little more than a whole turn."""
LEAST_GAP_S, LONGEST_GAP_S = 1e-9, 1.0
"""Between neighbouring samples: across a shorter one the slope is no number, across a longer one a straight line is no
wish of anybody's."""
RATES_HZ = (10.0, 100.0)
FIX = "Give a header time_s,torque_nm (or torque_nm alone) and one row of numbers a line."
NAMES = {"time_s": "time_s", "torque_nm": "torque_nm", "reference_torque_nm": "torque_nm", "angle_rad": "angle_rad"}


@dataclass(frozen=True)
class Reference:
    """Torque above rest, mean over each pulse interval.

    With an angle it is the whole torque that the cell measures, passive torque included, above that of a joint at rest
    at the first angle.
    """

    torque_nm: np.ndarray  # with the sign that the record of the model has, shape (K,)
    pulse_rate_hz: float = 40.0  # pulses a second
    angle_rad: np.ndarray | None = None  # of the joint, where it moves, mean over each pulse interval, shape (K,)

    @property
    def motion(self) -> JointMotion | None:
        """Motion of the joint; None where the reference has no angle."""
        return None if self.angle_rad is None else motion_of(self.angle_rad, self.pulse_rate_hz)

    @classmethod
    def of(
        cls,
        torque_nm: object,
        time_s: object = None,
        *,
        angle_rad: object = None,
        pulse_rate_hz: float = 40.0,
        name: str = "reference_torque_nm",
    ) -> Reference:
        """A reference as somebody gives it.

        Parameters
        ----------
        torque_nm : array_like, shape (N,)
            N·m above rest.
        time_s : array_like, shape (N,), optional
            Times, s, rising, in any steps; the first is that of the first pulse. None: one torque for each pulse.
        angle_rad : array_like, shape (N,), optional
            Angle of the joint at each torque, rad. A model that depends on the joint needs it.
        pulse_rate_hz : float
            Pulses per second.
        name : str
            How the torque is called in messages.

        Raises
        ------
        BadRequest
            Empty, too long, not finite, times that do not rise, another number of times than torques.
        """
        if not RATES_HZ[0] <= pulse_rate_hz <= RATES_HZ[1]:
            fix = f"Give {RATES_HZ[0]:g} to {RATES_HZ[1]:g}, the rate at which the model was identified."
            raise BadRequest(f"{pulse_rate_hz:g} pulses a second", place="pulse_rate_hz", fix=fix)
        torque = _column(torque_nm, name, LARGEST_NM, "N·m", "mN·m")
        like = torque.size, name
        angle = None if angle_rad is None else _column(angle_rad, "angle_rad", LARGEST_RAD, "rad", "degrees", like)
        times = None if time_s is None else _column(time_s, "time_s", like=like)
        seconds = torque.size / pulse_rate_hz if times is None else _span_s(times)
        if seconds > LONGEST_S:
            place, fix = name if times is None else "time_s", f"Give at most {LONGEST_S:g} s, one trial."
            raise BadRequest(f"{seconds:.5g} s long", place=place, fix=fix)
        if times is not None:
            torque = _on_pulses(times, torque, pulse_rate_hz)
            angle = None if angle is None else _on_pulses(times, angle, pulse_rate_hz)
        return cls(torque, float(pulse_rate_hz), angle)


def _column(
    values: object,
    place: str,
    largest: float = np.inf,
    unit: str = "",
    mistaken_unit: str = "",
    like: tuple[int, str] | None = None,
) -> np.ndarray:
    """Finite numbers, none larger than `largest`; `like`: size and name of the torques that they go with."""
    try:
        column = np.asarray(values, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadRequest("not a list of numbers", place=place, fix="Give one number for each pulse, N·m.") from error
    if column.ndim != 1:
        raise BadRequest(f"{column.ndim} dimensions", place=place, fix="Give a plain list of numbers.")
    if column.size == 0:
        raise BadRequest("empty", place=place, fix="Give at least one number.")
    if column.size > MOST_SAMPLES:
        raise BadRequest(f"{column.size} numbers", place=place, fix=f"Give at most {MOST_SAMPLES}.")
    bad = np.flatnonzero(~np.isfinite(column))
    if bad.size:
        fix = "Give a finite number at every place."
        raise BadRequest(f"{column[bad[0]]} is not a number that can be followed", place=f"{place}[{bad[0]}]", fix=fix)
    if like is not None and column.size != like[0]:
        what = place.partition("_")[0]
        message = f"{column.size} {what}s for {like[0]} of {like[1]}"
        raise BadRequest(message, place=place, fix=f"Give one {what} for each torque.")
    large = np.flatnonzero(np.abs(column) > largest)
    if large.size:
        fix = f"At most {largest:g} {unit}; is it in {mistaken_unit}?"
        raise BadRequest(f"{column[large[0]]:g} {unit}", place=f"{place}[{large[0]}]", fix=fix)
    return column


def _span_s(time_s: np.ndarray) -> float:
    """Length of a time axis. Raises BadRequest: it has one time only, or does not rise in steps that can be."""
    if time_s.size < 2:
        raise BadRequest("one time only", place="time_s", fix="Give two or more, or leave the times out.")
    step_s = np.diff(time_s)
    wrong = np.flatnonzero(~((step_s >= LEAST_GAP_S) & (step_s <= LONGEST_GAP_S)))
    if wrong.size:
        at = wrong[0] + 1
        fix = f"Times must rise, by at least {LEAST_GAP_S:g} s and at most {LONGEST_GAP_S:g} s."
        raise BadRequest(f"{time_s[at]:.9g} s after {time_s[at - 1]:.9g} s", place=f"time_s[{at}]", fix=fix)
    return float(time_s[-1] - time_s[0])


def _on_pulses(time_s: np.ndarray, torque_nm: np.ndarray, pulse_rate_hz: float) -> np.ndarray:
    """Means of straight lines between the samples over each pulse interval, shape (K,)."""
    size = max(1, round((time_s[-1] - time_s[0]) * pulse_rate_hz))
    edges = time_s[0] + np.arange(size + 1) / pulse_rate_hz
    fine = np.union1d(time_s, edges)  # between neighbours of these a line is straight
    value = np.interp(fine, time_s, torque_nm)
    area = np.r_[0.0, np.cumsum(np.diff(fine) * (value[1:] + value[:-1]) / 2)]
    return np.diff(np.interp(edges, fine, area)) * pulse_rate_hz


# ---- tables ----


def read_reference(content: bytes, name: str, pulse_rate_hz: float = 40.0) -> Reference:
    """The reference in a CSV file; semicolons or tabs between cells and decimal commas are read, too.

    `content`: the file; `name`: how messages call it; `pulse_rate_hz`: pulses per second. Raises BadRecord: it is no
    such table: with line and column.
    """
    encoding, _ = encoding_of(content, name)
    lines = ((number, line.strip("\r\n ")) for number, line in enumerate(text_lines(content, encoding, name), 1))
    rows = ((number, line) for number, line in lines if line.strip() and not line.startswith(COMMENTS))
    number, head = next(rows, (0, ""))
    if not head:
        raise BadRecord("empty", place=name, fix=FIX)
    separator = next((sign for sign in ";\t," if sign in head), ",")
    header = [cell.strip().strip('"').lower() for cell in head.split(separator)]
    known = [NAMES[cell] for cell in header if cell in NAMES]
    if sorted(set(known) - {"time_s", "angle_rad"}) != ["torque_nm"] or len(set(known)) != len(known):
        raise BadRecord("no header with torque_nm", place=f"{name}, line {number}", fix=FIX)
    columns: dict[str, list[float]] = {column: [] for column in known}
    for count, (number, line) in enumerate(rows, 1):
        place, cells = f"{name}, line {number}", line.split(separator)
        if count > MOST_SAMPLES:
            fix = f"Give at most {MOST_SAMPLES}: one for each pulse is enough."
            raise BadRecord(f"more than {MOST_SAMPLES} rows", place=place, fix=fix)
        if any(cell.strip() for cell in cells[len(header) :]):  # the comma of a decimal makes two cells of one number
            decimals = "with decimal commas, separate the cells with semicolons, or write decimal points"
            fix = f"Name every column; {decimals}." if separator == "," else "Name every column."
            raise BadRecord(f"{len(cells)} cells under a header of {len(header)}", place=place, fix=fix)
        for at, cell in enumerate(header):
            if cell in NAMES:
                text = cells[at].strip().strip('"') if at < len(cells) else ""
                text = text if separator == "," else text.replace(",", ".")
                value = float(text) if is_number(text) else np.nan
                if not np.isfinite(value):
                    raise BadRecord(f"{text[:20]!r} is not a finite number", place=f"{place}, column {cell}", fix=FIX)
                columns[NAMES[cell]].append(value)
    torque_nm = columns.pop("torque_nm")
    return Reference.of(torque_nm, **columns, pulse_rate_hz=pulse_rate_hz, name=f"{name}, torque_nm")  # type: ignore
