"""Records as measured human arms give them: bouts of several kinds, readings that are held, jumps, a zero that wanders.

The muscle has two parallel ways, quick and slow, each with its own recruitment curve and two equal lags in a row, so
that twitches and short bouts look fast and ramps slow: no single second-order model describes both. Twitches, short
bouts, a PRBS, short bouts again, then four equal slow ramps; the last ramp is `validate`.

Seeds 0 to 99 are for development; reported figures use seeds from 1000.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter

from stimrig.hardware_sim.hidden import recruitment
from stimrig.hardware_sim.hidden.base import TABLE_SIZE
from stimrig.hardware_sim.hidden.design import PULSES_PER_S, prbs, triangle
from stimrig.hardware_sim.hidden.kernels import Floats
from stimrig.hardware_sim.hidden.scenario import rng_of

RATES_HZ = (400, 800, 1000)
QUICK_S, SLOW_S = (0.06, 0.15), (0.4, 0.8)
QUICK_SHARE = (0.35, 0.65)
SPREAD_NM = (0.03, 1.0)
"""Standard deviation of the torque that stimulation makes: as small as on arms."""
READ_HZ = (20.0, 45.0)
RAMPS = 4
BOUT_VARIES, LATER_US = 0.05, 1.0
"""Between bouts: a factor's standard deviation, and by how many µs the threshold moves."""
WEAKER = (0.7, 0.9)
WEAKER_IN = 0.15
"""Share of the records whose last bout is weaker."""


@dataclass(frozen=True)
class Bouts:
    """Pulse widths at 40 pulses/s, µs, with the segment and the number of the bout of each; shape (n,).

    A rest belongs to the bout before it, as its decay does.
    """

    width_us: Floats
    segment: np.ndarray
    bout: np.ndarray


def record_of_bouts(seed: int) -> dict[str, Any]:
    """The record of this seed.

    Returns
    -------
    dict
        `time_s`, `pulse_width_us`, `torque_nm`, `segment`, shape (n,), at 400, 800 or 1000 Hz; `bout`, the number of
        the bout of each row, and `clean_nm`, the muscle's torque alone, which a method must not see; and `truth`.
    """
    rng = rng_of(seed, "bouts")
    rate_hz = int(rng.choice(RATES_HZ))
    largest_us = int(rng.integers(200, 401))
    bouts = draw_bouts(rng_of(seed, "bouts", "design"), float(largest_us))
    repeated = rate_hz // PULSES_PER_S
    clean_nm, muscle = _muscle_nm(seed, bouts, largest_us, rate_hz)
    working = np.repeat(bouts.width_us > 0.0, repeated)
    added_nm, sensor = _disturbed_nm(seed, working, muscle["spread_nm"], rate_hz)
    reading_nm, sensor["read_hz"] = _sample_and_hold(rng_of(seed, "bouts", "converter"), clean_nm + added_nm, rate_hz)
    return {
        "time_s": np.arange(clean_nm.size) / rate_hz,
        "pulse_width_us": np.repeat(bouts.width_us, repeated),
        "torque_nm": reading_nm,
        "segment": np.repeat(bouts.segment, repeated),
        "bout": np.repeat(bouts.bout, repeated),
        "clean_nm": clean_nm,
        "truth": {"seed": seed, "rate_hz": rate_hz, "muscle": muscle, "sensor": sensor},
    }


def draw_bouts(rng: Generator, top_us: float) -> Bouts:
    """Twitches, short bouts, PRBS, short bouts, four equal ramps of which the last is `validate`; rests between."""
    level = lambda: top_us * float(rng.uniform(0.5, 1.0))  # noqa: E731
    short = lambda: ("bout", np.full(int(rng.integers(4, 25)), level()))  # noqa: E731
    ramp = triangle(top_us * float(rng.uniform(0.85, 1.0)), float(rng.uniform(3.0, 6.0)))
    parts = [("twitch", np.array([level()])) for _ in range(int(rng.integers(3, 7)))]
    parts += [short() for _ in range(int(rng.integers(2, 6)))]
    parts += [("prbs", prbs(level(), 4, int(rng.integers(1, 128)))[: int(rng.integers(200, 401))])]
    parts += [short() for _ in range(int(rng.integers(2, 6)))]
    parts += [("ramp", ramp)] * (RAMPS - 1) + [("validate", ramp)]
    widths, segments, numbers = [np.zeros(80)], [np.full(80, "rest", "U12")], [np.zeros(80, int)]
    for number, (name, width_us) in enumerate(parts):
        rest = round(PULSES_PER_S * float(rng.uniform(3.0, 6.0) if width_us.size > 1 else rng.uniform(1.5, 3.0)))
        # what decays after the unseen ramp is unseen as well
        after = np.full(rest, "validate" if name == "validate" else "rest", "U12")
        widths += [width_us, np.zeros(rest)]
        segments += [np.full(width_us.size, name, "U12"), after]
        numbers += [np.full(width_us.size + rest, number)]
    return Bouts(np.round(np.concatenate(widths)), np.concatenate(segments), np.concatenate(numbers))


def _muscle_nm(seed: int, bouts: Bouts, largest_us: int, rate_hz: int) -> tuple[Floats, dict[str, Any]]:
    """Return the muscle's torque at every sample, N·m, and the drawn parameters."""
    rng, variation = rng_of(seed, "bouts", "muscle"), rng_of(seed, "bouts", "variation")
    last = int(bouts.bout[-1])
    gain = 1.0 + BOUT_VARIES * variation.standard_normal(last + 1)
    later_us = LATER_US * variation.standard_normal(last + 1)
    chance, size = rng.random(), float(rng.uniform(*WEAKER))
    weaker = size if chance < WEAKER_IN else 1.0
    gain[last] *= weaker
    quick_s, slow_s = (float(np.exp(rng.uniform(*np.log(bounds)))) for bounds in (QUICK_S, SLOW_S))
    share = float(rng.uniform(*QUICK_SHARE))
    felt_us = np.where(bouts.width_us > 0.0, np.maximum(bouts.width_us - later_us[bouts.bout], 0.0), 0.0)
    torque, shapes = np.zeros(felt_us.size * (rate_hz // PULSES_PER_S)), []
    for part, tau_s in ((share, quick_s), (1.0 - share, slow_s)):
        shape, table, _, own_largest_us = recruitment.draw(rng, False, TABLE_SIZE)
        share_of_top = np.interp(felt_us * own_largest_us / largest_us, np.arange(TABLE_SIZE), table)
        drive = part * share_of_top / table[own_largest_us] * gain[bouts.bout]
        torque += _two_lags(np.repeat(drive, rate_hz // PULSES_PER_S), tau_s, rate_hz)
        shapes.append(shape)
    spread_nm = float(np.exp(rng.uniform(*np.log(SPREAD_NM))))
    before = np.repeat(bouts.bout < last, rate_hz // PULSES_PER_S)  # so that a weaker last bout changes no other
    size_nm = spread_nm / float(np.std(torque[before])) * float(rng.choice([-1.0, 1.0]))
    parameters = {"spread_nm": spread_nm, "size_nm": size_nm, "weaker": weaker, "tau_s": [quick_s, slow_s]}
    return size_nm * torque, parameters | {"shares": [share, 1.0 - share], "recruitment": shapes}


def _two_lags(drive: Floats, tau_s: float, rate_hz: int) -> Floats:
    """Two equal lags in a row, exact for an input that is held over each sample; torque follows pulses before it."""
    pole = math.exp(-1.0 / (rate_hz * tau_s))
    # the zero-order hold of 1 / (1 + τs)²
    first = 1.0 - pole - pole * -math.log(pole)
    second = pole * pole - pole + pole * -math.log(pole)
    return np.asarray(lfilter([0.0, first, second], [1.0, -2.0 * pole, pole * pole], drive))


def _disturbed_nm(seed: int, working: np.ndarray, spread_nm: float, rate_hz: int) -> tuple[Floats, dict[str, Any]]:
    """Return the sensor's error at every sample, N·m: jumps that creep back, and the zero; and the parameters."""
    count = working.size
    rng = rng_of(seed, "bouts", "noise")
    rng.standard_normal(count)  # drawn and left: the numbers below stay those of earlier figures
    per_s, creep_s = float(rng.uniform(0.4, 1.5)), float(rng.uniform(0.3, 3.0))
    size_nm = spread_nm * float(rng.uniform(0.04, 0.1))
    jump = np.where(rng.random(count) < per_s / rate_hz, rng.standard_t(2.5, count), 0.0) * size_nm
    added = lfilter([1.0], [1.0, -math.exp(-1.0 / (rate_hz * creep_s))], jump)
    rng = rng_of(seed, "bouts", "zero")
    speed_nm = spread_nm * float(np.exp(rng.uniform(*np.log((0.003, 0.015)))))
    # the zero walks six times as quick (in variance) between bouts as in them
    steps = rng.standard_normal(count) * np.where(working, 1.0, math.sqrt(6.0)) * speed_nm / math.sqrt(rate_hz)
    # an arm settles over tenths of a second: a walk of its speed, not of white steps
    added = added + np.cumsum(lfilter([1.0 - math.exp(-3.0 / rate_hz)], [1.0, -math.exp(-3.0 / rate_hz)], steps))
    offset_nm = spread_nm * float(rng_of(seed, "bouts", "offset").normal(0.0, 2.0))
    parameters = {"jumps_per_s": per_s, "creep_s": creep_s, "jump_nm": size_nm, "zero_nm_per_root_s": speed_nm}
    return added + offset_nm, parameters | {"offset_nm": offset_nm}


def _sample_and_hold(rng: Generator, torque: Floats, rate_hz: int) -> tuple[Floats, float]:
    """Repeat each reading until the next, read by an uneven clock; return the readings and its mean rate, Hz."""
    read_hz = float(rng.uniform(*READ_HZ))
    gap = np.maximum(np.round(rate_hz / read_hz * rng.uniform(0.7, 1.3, torque.size // 4)), 1.0).astype(int)
    read = np.cumsum(gap)
    read = np.concatenate([[0], read[read < torque.size]])
    return np.repeat(torque[read], np.diff(np.append(read, torque.size))), read_hz
