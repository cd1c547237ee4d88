"""Tests that the rig can do, as segments with settings, and their pulse widths for simulation.

`identify` does not import the rig. These shapes repeat the meaning of the rig's settings; a test compares both.

An adaptive test is made of pieces of one to two seconds: holds, steps, ramps and random steps between levels. Each is a
list of pulse widths, which the rig's sequence `widths` plays as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Segment:
    """One sequence with its settings."""

    name: str  # of the segment in the recording
    sequence: str  # rest, prbs, ramp, staircase, steps or widths
    settings: dict[str, Any]  # as the rig expects them

    def to_dict(self) -> dict[str, Any]:
        """As `POST /v1/tests` takes it."""
        return dict(vars(self))


@dataclass(frozen=True)
class Design:
    """A test."""

    words: str  # what people call it
    segments: tuple[Segment, ...]  # in order

    def pulse_widths(self, pulse_rate_hz: float) -> np.ndarray:
        """Pulse widths, one per pulse, µs."""
        return np.concatenate([SHAPES[s.sequence](s.settings, pulse_rate_hz) for s in self.segments])


def _prbs(s: dict[str, Any], _rate: float) -> np.ndarray:
    taps = {5: (5, 3), 6: (6, 5), 7: (7, 6)}[s["bits"]]
    state = (s["seed"] - 1) % (2 ** s["bits"] - 1) + 1
    bits = []
    for _ in range(s["chips"]):
        bits.append(state >> (s["bits"] - 1) & 1)
        feedback = (state >> (taps[0] - 1) ^ state >> (taps[1] - 1)) & 1
        state = (state << 1 | feedback) & (2 ** s["bits"] - 1)
    return np.repeat(np.array(bits, float) * s["max_pulse_width_us"], s["clock_pulses"])


def _ramp(s: dict[str, Any], rate: float) -> np.ndarray:
    up, down = round(s["up_s"] * rate), round(s["down_s"] * rate)
    return np.r_[np.arange(1, up + 1) / up, np.arange(down - 1, -1, -1) / down] * s["max_pulse_width_us"]


def _steps(s: dict[str, Any], rate: float) -> np.ndarray:
    on = np.full(round(s["on_s"] * rate), s["max_pulse_width_us"])
    return np.tile(np.r_[on, np.zeros(round(s["off_s"] * rate))], s["repeats"])


def _staircase(s: dict[str, Any], rate: float) -> np.ndarray:
    up = np.arange(1, s["levels"] + 1) / s["levels"]
    return np.repeat(np.r_[up, up[-2::-1], 0.0] * s["max_pulse_width_us"], round(s["hold_s"] * rate))


SHAPES: dict[str, Callable[[dict[str, Any], float], np.ndarray]] = {
    "rest": lambda s, rate: np.zeros(round(s["duration_s"] * rate)),
    "widths": lambda s, _rate: np.array(s["pulse_width_us"], float),
    "ramp": _ramp, "steps": _steps, "staircase": _staircase, "prbs": _prbs,
}  # fmt: skip
"""Pulse widths of the designs' sequences, by the settings that these designs have."""


def designs(largest_us: float) -> list[Design]:
    """All designs, for a largest pulse width, µs; none exceeds it."""
    top = float(largest_us)

    def rest(seconds: float, name: str = "rest") -> Segment:
        return Segment(name, "rest", {"duration_s": seconds})

    def ramp(seconds: float, name: str = "ramp") -> Segment:
        return Segment(name, "ramp", {"max_pulse_width_us": top, "up_s": seconds, "down_s": seconds})

    def steps(on: float, off: float, repeats: int, share: float = 1.0) -> Segment:
        settings = {"max_pulse_width_us": round(share * top, 1), "on_s": on, "off_s": off, "repeats": repeats}
        return Segment("steps", "steps", settings)

    def prbs(share: float) -> Segment:
        width = {"max_pulse_width_us": round(share * top, 1)}
        return Segment("prbs", "prbs", width | {"bits": 7, "clock_pulses": 4, "chips": 40, "seed": 3})

    stairs = Segment("staircase", "staircase", {"max_pulse_width_us": top, "levels": 6, "hold_s": 1.0, "down": True})
    return [
        Design("One more ramp", (rest(2), ramp(5), rest(2))),
        Design("A fast ramp", (rest(2), ramp(1.5), rest(2))),
        Design("Two ramps with a short rest between them", (rest(2), ramp(4), rest(2), ramp(4), rest(2))),
        Design("A fast ramp and a slow one", (rest(2), ramp(1.5), rest(2), ramp(6), rest(2))),
        Design("A ramp, a long rest, a ramp", (rest(2), ramp(4), rest(15), ramp(4), rest(2))),
        Design("Steps on and off", (rest(2), steps(1.0, 1.5, 4), rest(2))),
        Design(
            "Steps on and off at three levels",
            (rest(2), steps(0.8, 1.2, 2, 0.45), steps(0.8, 1.2, 2, 0.7), steps(0.8, 1.2, 2), rest(2)),
        ),
        Design(
            "A short random sequence at each of three levels",
            (rest(2), prbs(0.45), rest(1), prbs(0.7), rest(1), prbs(1.0), rest(2)),
        ),
        Design("A staircase up and down", (rest(2), stairs, rest(2))),
        Design("One long step", (rest(2), steps(6.0, 5.0, 1))),
        Design(
            "A ramp, 10 s of stimulation, a ramp, a rest, a ramp",
            (rest(2), ramp(3), steps(10.0, 1.0, 1), ramp(3), rest(15), ramp(3), rest(2)),
        ),
        Design("A test without stimulation", (rest(10, "sham"),)),
    ]


LEVELS_S, SHORTEST_S, LONGEST_S = 26.0, 0.25, 1.25
"""Seconds of held random levels, and of each level."""
OFTEN_S = 5.0
"""Seconds of levels after which there is a rest of one second: it shows what the muscle keeps of its work."""


def held_levels(largest_us: float, threshold_us: float, pulse_rate_hz: float, seed: int) -> list[Design]:
    """Random levels, each held for a while, as no ramp and no PRBS has them: jumps of level while stimulated.

    In one design they are even between the threshold and the largest width, in the second half of them lie near the
    threshold, where a slow ramp spends little time and a PRBS none; in the third ramps of two speeds follow.
    """
    pause, tests = Segment("rest", "rest", {"duration_s": 2.0}), []
    ramps_us = [_ramp({"up_s": s, "down_s": s, "max_pulse_width_us": largest_us}, pulse_rate_hz) for s in (1.2, 4.0)]
    for words, near, ramps in (
        ("Random levels, each held for a moment", 0.0, False),
        ("Random levels, many near the threshold", 0.5, False),
        ("Random levels, a fast ramp and a slow one", 0.0, True),
    ):
        rng = np.random.default_rng(seed)
        levels: list[tuple[float, float]] = []
        rested_s = 0.0
        while sum(seconds for _, seconds in levels) < (0.6 if ramps else 1.0) * LEVELS_S:
            top_us = min(1.5 * threshold_us, largest_us) if rng.random() < near else largest_us
            levels.append((rng.uniform(0.9 * threshold_us, top_us), rng.uniform(SHORTEST_S, LONGEST_S)))
            rested_s += levels[-1][1]
            if rested_s > OFTEN_S:
                levels.append((0.0, 1.0))
                rested_s = 0.0
        widths_us = [np.full(round(seconds * pulse_rate_hz), us) for us, seconds in levels]
        if ramps:
            widths_us += [np.r_[np.zeros(round(pulse_rate_hz)), ramp_us] for ramp_us in ramps_us]
        tests.append(Design(words, (pause, played_widths("levels", np.concatenate(widths_us)), pause)))
    return tests


def played_widths(name: str, width_us: np.ndarray) -> Segment:
    """A segment of given widths, rounded down as the rig takes them."""
    return Segment(name, "widths", {"pulse_width_us": (np.floor(10.0 * width_us) / 10.0).tolist(), "jumps": True})


PIECE_S = 1.0
LONG_S = 2.0
HALF_S = 0.5
CHIP_S = 0.1
CHIPS = (1, 0, 0, 1, 1, 0, 1, 0, 1, 1)
"""Signs of a random piece: runs of different lengths, as often high as low or nearly so."""


def pieces(levels_us: np.ndarray, pulse_rate_hz: float) -> list[Segment]:
    """All pieces of an adaptive test between some levels, 0 among them; named hold, step, ramp or prbs."""
    levels = np.unique(np.round(np.floor(10.0 * levels_us) / 10.0, 1))
    full, half, long = (max(round(s * pulse_rate_hz), 2) for s in (PIECE_S, HALF_S, LONG_S))
    chip = max(round(CHIP_S * pulse_rate_hz), 1)
    candidates = [played_widths("hold", np.full(full, level)) for level in levels]
    for first, second in permutations(levels, 2):
        candidates.append(played_widths("step", np.repeat([first, second], half)))
        ramps = (first + (second - first) * np.arange(1, size + 1) / size for size in (full, long))
        candidates += [played_widths("ramp", ramp) for ramp in ramps]
        if first > second:
            candidates.append(played_widths("prbs", np.repeat(np.where(CHIPS, first, second), chip)))
    return candidates
