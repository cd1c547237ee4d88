"""Tetani of frog plantaris in vitro at constant width: the last one of an animal from those before it.

A file holds three pairs of time, ms, and volts: lever, force, stimulus. A pulse is a rising edge above 2 V.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

import numpy as np

from bench.measured import Absent, Place

FROGS = Place("MyoPhys/muscle-scaling", "e278169", "Raw Data/P0 and Twitches")
TETANUS = re.compile(r"(Os\d+)_20C_(Settling|P0\d?)_Trial(\d+)")
BEFORE = 2
"""Intervals of rest at the begin."""
SAME_RATE = 0.03
"""Share by which the pulse rates of two tetani may differ."""
Trial = tuple[float, np.ndarray, np.ndarray]
"""Pulse interval, s; then for each interval whether there was a pulse, and the force at its start, V."""


def trial(path: Path) -> Trial:
    """One tetanus on the grid of its pulses and before them."""
    cells = [line.split("\t")[:6] for line in re.split(r"[\r\n]+", path.read_text(encoding="latin-1"))]
    rows = np.array([line for line in cells if len(line) == 6 and all(map(_is_number, line))], float)
    time_s, force, stimulus = rows[:, 0] / 1000, rows[:, 3] - np.median(rows[:20, 3]), rows[:, 5]
    edges = time_s[1:][(stimulus[1:] > 2) & (stimulus[:-1] <= 2)]
    step_s = float(edges[-1] - edges[0]) / (edges.size - 1)
    at = np.arange(edges[0] - BEFORE * step_s, time_s[-1], step_s)
    pulse = (np.arange(at.size) >= BEFORE) & (np.arange(at.size) < BEFORE + edges.size)
    return step_s, pulse, np.interp(at, time_s, force)


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def animals(data: Path | None = None) -> dict[str, list[Trial]]:
    """By animal, its tetani of one pulse rate in the order in which they were done; two at least.

    Raises
    ------
    Absent
        There is no local copy.
    """
    files: dict[str, list[tuple[int, Path]]] = defaultdict(list)
    for path in FROGS.local(data).iterdir():
        if named := TETANUS.fullmatch(path.name):
            files[named[1]].append((int(named[3]), path))
    found = {}
    for animal, paths in sorted(files.items()):
        trials = [trial(path) for _, path in sorted(paths)]
        alike = [one for one in trials if abs(one[0] / trials[-1][0] - 1) < SAME_RATE]
        if len(alike) > 1:
            found[animal] = alike
    if not found:
        raise Absent(f"absent: no tetanus at {FROGS.local(data)}")
    return found
