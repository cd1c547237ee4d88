"""What a file of another tool holds, whatever its format: signals, and spans of time that have names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stimrig.identify.errors import BadRecord

MOST_SIGNALS = 500
FIX = "Give the whole file, as the tool that made it wrote it."
PLAIN = {
    "second": "s", "seconds": "s", "sec": "s", "millisecond": "ms", "milliseconds": "ms", "microsecond": "us",
    "microseconds": "us", "newton": "N", "newtons": "N", "newtonmeter": "Nm", "newtonmeters": "Nm", "newtonmetre": "Nm",
    "newtonmetres": "Nm", "radian": "rad", "radians": "rad", "radians/second": "rad/s", "degree": "deg",
    "degrees": "deg", "degrees/second": "deg/s", "n/a": "", "unknown": "", "a.u.": "", "au": "",
}  # fmt: skip
"""Units that formats write in words."""


@dataclass(frozen=True)
class Signal:
    """A column of numbers with its times."""

    name: str  # how `--map` calls it
    time_s: np.ndarray  # shape (N,)
    values: np.ndarray  # shape (N,); NaN: no number; of marks without a number all NaN
    unit: str = ""  # as the file says it, in short; empty where it does not
    events: bool = False  # a value each time something happened, not samples of what goes on
    clock: str = ""  # the clock of its times; signals of one file with one clock need no offset

    @property
    def shown(self) -> str:
        """As a choice of a question."""
        rate_hz = (self.time_s.size - 1) / max(float(np.ptp(self.time_s)), 1e-9) if self.time_s.size > 1 else 0.0
        kind = "marks" if self.events else f"samples at {rate_hz:.4g} Hz"
        return f"{self.name} ({self.unit or 'unit not said'}, {self.time_s.size} {kind})"


@dataclass(frozen=True)
class Spans:
    """Spans of time with a name each, in the order of their starts."""

    name: str
    rows: tuple[tuple[str, float, float], ...]  # name, start and end in s, end exclusive
    clock: str = ""


@dataclass(frozen=True)
class Foreign:
    """What a file holds; `own` are answers that a file of our own gives, by the name of the option."""

    format: str
    signals: tuple[Signal, ...]
    spans: tuple[Spans, ...] = ()
    own: Mapping[str, str] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)  # participant, recording_id, … where the file says them
    told: tuple[str, ...] = ()  # what was done or found when it was read


def plain(unit: str) -> str:
    """A unit in short: formats write `seconds`, `newton_meters`."""
    return PLAIN.get(unit.strip().lower().replace("_", "").replace(" ", "").replace("-", ""), unit.strip())


def spans_of_rows(name: str, time_s: np.ndarray, index: np.ndarray, names: list[str]) -> Spans:
    """Spans from a name's index for each sample, −1 for none; each ends one sample after its last."""
    if not time_s.size:
        return Spans(name, ())
    starts = np.flatnonzero(np.r_[True, np.diff(index) != 0])
    ends = np.r_[starts[1:], index.size] - 1
    step_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0
    rows = [(names[index[a]], float(time_s[a]), float(time_s[b]) + step_s / 2) for a, b in
            zip(starts.tolist(), ends.tolist(), strict=True) if index[a] >= 0]  # fmt: skip
    return Spans(name, tuple(rows))


def whole(found: Foreign, place: str) -> Foreign:
    """The same, looked at. Raises BadRecord: nothing in it, too much, or two signals of one name."""
    names = [signal.name for signal in found.signals]
    if not names:
        raise BadRecord(f"no column of numbers with times ({found.format})", place=place, fix=FIX)
    if len(names) > MOST_SIGNALS:
        raise BadRecord(f"{len(names)} columns, at most {MOST_SIGNALS} are read", place=place, fix=FIX)
    if twice := [name for name in names if names.count(name) > 1]:
        raise BadRecord(f"two columns are called {twice[0]!r}", place=place, fix="Rename one of them.")
    for signal in found.signals:
        if signal.time_s.size != signal.values.size:
            message = f"{signal.name} has {signal.values.size} values and {signal.time_s.size} times"
            raise BadRecord(message, place=place, fix=FIX)
    return found
