"""Effects that no library has: a diagnosis must say that something is there, and name nothing."""

from __future__ import annotations

import math

import numpy as np

from stimrig.hardware_sim.hidden.base import delayed, second_order_step
from stimrig.hardware_sim.hidden.forms import Counted, Effect, Form, Numbers, Sign, draws, weighted
from stimrig.hardware_sim.hidden.kernels import (
    ACTIVATION,
    COUNT,
    LARGEST_NM,
    PULSE,
    STEP_S,
    TIME_S,
    WIDTH_US,
    Stage,
    normal,
)

NAMES = (
    "after_discharge", "antagonist", "clonus", "delay_jitter", "fixture_backlash", "gain_jumps", "loose_contact",
    "pulse_count_memory", "rate_dependent_recruitment", "residual_force", "sensor_gain_swing", "slipped_electrode",
    "slow_converter", "stick_slip", "width_dependent_delay",
)  # fmt: skip
COUNTED: dict[str, Counted] = {
    **dict.fromkeys(("clonus", "delay_jitter", "gain_jumps", "loose_contact", "sensor_gain_swing"), "all"),
    "slipped_electrode": "training",
}
OUTSIDERS = {name: Effect(COUNTED.get(name, "held out")) for name in NAMES}


# Plateau potentials: strong stimulation sets off an after-discharge that goes on by itself until it dies out.
@OUTSIDERS["after_discharge"].form(
    "after-discharge switched on by strong stimulation", "plateau potentials, Bennett, Li and Siu 2001"
)
@draws("gain", 0.9, "size_share", threshold_share=(0.4, 0.65), takes_s=(0.15, 0.5), lasts_s=(0.5, 1.8))
def _bistable(x, p, s, c):
    """p: size share, activation that sets it off, time it takes s, how long it lasts s. s: charge, age, on."""
    s[0] += (c[ACTIVATION] - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    if s[2] < 0.5 and s[0] > p[1]:
        s[2] = 1.0
        s[1] = 0.0
    if s[2] > 0.5:
        s[1] += c[STEP_S]
        if s[1] > p[3]:
            s[2] = 0.0
            s[0] = 0.0
    return x + p[0] * c[LARGEST_NM] * s[2]


# Antagonist cross-talk: at large pulse widths current spreads to the antagonist, which pulls back, more slowly.
def _spill_us(rng, base):
    return min(base.rise_us()[1], base.largest_width_us * 0.8) * float(rng.uniform(0.7, 0.95))


def _slower(rng, base):
    rate = 1.0 / (base.t_omega_s * float(rng.uniform(2.0, 4.0)))
    return Numbers((rate, 1.1), slower_by=1.0 / (rate * base.t_omega_s))


@OUTSIDERS["antagonist"].form(
    "a slow, quickly tiring antagonist at large widths", "spill-over to the antagonist, as in Durfee and MacLean 1989"
)
@draws("additive", 1.5, "share", threshold_us=_spill_us, rise_us=(15.0, 60.0), _slower=_slower, tiring_s=(1.5, 5.0))
def _pull_back(x, p, s, c):
    """p: largest pull as a share, threshold µs, rise µs, 1/Tω, ζ, fatigue s. s: pull and its speed, late copy."""
    w = c[WIDTH_US] - p[1]
    drive = 1.0 - math.exp(-w / p[2]) if w > 0.0 else 0.0
    tired = 1.0 / (1.0 + s[3])
    s[3] += c[STEP_S] * (drive * 0.8 - s[3] / p[5])
    return x - p[0] * c[LARGEST_NM] * second_order_step(drive * tired, p[3], p[4], s, 0, c[STEP_S])


# Clonus: after a sudden change of torque the muscle beats by itself for a while.
@OUTSIDERS["clonus"].form(
    "beats set off by a fall of torque", "Van der Pol oscillator; clonus at 5 to 7 Hz, Hidler and Rymer 1999"
)
@draws("additive", 0.8, "size_share", frequency_hz=(4.5, 7.5), decay_s=(0.4, 1.5))
def _beats(x, p, s, c):
    """p: size share, Hz, drive's decay s, delay s. s: oscillator (2), drive, activation before.

    A Van der Pol oscillator whose energy supply is switched on by a fall of activation and dies away.
    """
    fall = s[3] - c[ACTIVATION]
    s[3] = c[ACTIVATION]
    if fall > 0.3:
        s[2] = 1.0
        s[0] += 0.3
    s[2] *= math.exp(-c[STEP_S] / p[2])
    omega = 2.0 * math.pi * p[1]
    grow = omega * (0.6 * s[2] - 0.15)
    for _ in range(4):
        h = 0.25 * c[STEP_S]
        s[1] += h * (2.0 * grow * (1.0 - s[0] * s[0]) * s[1] - omega * omega * s[0])
        s[0] += h * s[1]
    size = s[0] * s[0] + s[1] * s[1] / (omega * omega)
    if size > 9.0:
        s[0] *= 3.0 / math.sqrt(size)
        s[1] *= 3.0 / math.sqrt(size)
    return x + p[0] * c[LARGEST_NM] * max(s[0], -0.4) * min(s[2] * 3.0, 1.0)


# Delay that jitters: the answer comes now sooner, now later, at random.
@OUTSIDERS["delay_jitter"].form("delay wanders at random", "made to be foreign")
@draws("delay", 0.16, "mean_delay_s", seed_at=2, correlation_s=(0.3, 2.0))
def _jitter(x, p, s, c):
    """p: mean delay s, its correlation s. s: place in the ring of 800, delay's state, generator."""
    s[1] += -c[STEP_S] * s[1] / p[1] + math.sqrt(2.0 * c[STEP_S] / p[1]) * normal(s, 2)
    return delayed(x, min(max(p[0] * (1.0 + 0.8 * s[1]), 0.0) / c[STEP_S], 780.0), s, 10, 800)


# Backlash in the fixture: the load cell follows the torque only after play has been taken up.
@OUTSIDERS["fixture_backlash"].form("play on torque", "backlash operator, Krasnosel'skii and Pokrovskii 1989")
@draws("structure", 0.4, "half_width_share", settling_s=(0.001, 0.01))
def _play(x, p, s, c):
    """p: half-width of the play as a share of the largest torque, settling s. s: follower, what is read."""
    half = p[0] * c[LARGEST_NM]
    s[0] = min(max(s[0], x - half), x + half)
    s[1] += (s[0] - s[1]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    return s[1]


# Jumps of gain: an electrode shifts at an instant and with it the share of the nerve it reaches.
def _jump_table(rng, _base):
    instants = float(rng.uniform(4.0, 10.0)) + np.cumsum(rng.uniform(3.0, 12.0, 60))
    gains = np.cumsum(np.where(np.arange(60) % 2 == 0, 1.0, -1.0) * rng.uniform(0.4, 1.6, 60))
    gains = np.clip(gains, -1.5, 1.5)
    table = np.column_stack([instants, gains]).ravel()
    return Numbers(table, first_instants_s=instants[:5].tolist(), first_gains=gains[:5].tolist())


@OUTSIDERS["gain_jumps"].form("gain jumps up and down", "electrode shift")
@draws("gain", 0.6, "size", _jump_table=_jump_table)
def _jumps(x, p, s, c):
    """p: size, then 60 pairs of instant and gain after it. s[0]: present pair."""
    while s[0] < 60.0 and c[TIME_S] >= p[1 + 2 * int(s[0])]:
        s[1] = p[2 + 2 * int(s[0])]
        s[0] += 1.0
    return x * max(1.0 + p[0] * s[1], 0.0)


# Loose contact: for moments no current flows, though pulses are sent.
def _gap_table(rng, _base):
    instants = np.cumsum(rng.uniform(0.6, 4.0, 200))
    table = np.column_stack([instants, rng.uniform(0.4, 1.6, 200)]).ravel()
    return Numbers(table, first_instants_s=instants[:5].tolist())


@OUTSIDERS["loose_contact"].form("current is cut for moments", "loose electrode lead")
@draws("electrode", 0.35, "typical_gap_s", _gap_table=_gap_table)
def _gaps(x, p, s, c):
    """p: length of a typical gap s, then 200 pairs of instant and relative length. s[0]: present pair."""
    i = int(s[0])
    while i < 200 and c[TIME_S] >= p[1 + 2 * i] + p[0] * p[2 + 2 * i]:
        i += 1
    s[0] = i
    if i < 200 and c[TIME_S] >= p[1 + 2 * i]:
        return 0.0
    return x


# Memory of the number of pulses: the gain goes up and down with how many pulses there have been.
@OUTSIDERS["pulse_count_memory"].form("gain swings with the count of pulses", "no physiology; made to be foreign")
@draws("gain", 0.9, "depth", pulses_a_turn=(60.0, 160.0))
def _all_pulses(x, p, s, c):
    """p: depth, pulses a turn. s[0]: pulses so far. A gain that swings with the pulses, not with time."""
    s[0] += c[PULSE]
    return x * (1.0 + p[0] * math.sin(2.0 * math.pi * s[0] / p[1]))


@OUTSIDERS["pulse_count_memory"].form("groups of pulses strong and weak in turn", "mechanical alternans, transposed")
@draws("gain", 0.9, "depth", pulses_a_group=lambda rng, _base: int(rng.integers(6, 14)))
def _every_other(x, p, s, c):
    """p: depth, pulses of a group. Alternans: groups of pulses of a train are strong and weak in turn."""
    group = int((max(c[COUNT], 1.0) - 1.0) / p[1])
    return x * (1.0 + (p[0] if group % 2 == 0 else -p[0]))


# Rate-dependent recruitment: how many fibres answer goes with how quickly the pulse width has just changed.
@OUTSIDERS["rate_dependent_recruitment"].form(
    "the nerve accommodates to the width", "accommodation, Hill 1936, transposed to pulse width"
)
@draws(
    "electrode",
    1.5,
    "share",
    time_constant_s=lambda rng, _base: math.exp(rng.uniform(math.log(0.1), math.log(0.6))),
    sign=Sign(weighted(0.3, 0.7)),
)
def _accommodation(x, p, s, c):
    """p: share, time constant s. s[0]: the width the nerve is used to. What differs from it counts more (or less)."""
    s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    return max(x + p[0] * (x - s[0]), 0.0) if x > 0.0 else 0.0


@OUTSIDERS["rate_dependent_recruitment"].form(
    "quick changes of width recruit less", "no law; recruitment that depends on the rate of change"
)
@draws("gain", 0.95, "share", time_constant_s=(0.15, 0.6), half_us_per_s=(500.0, 2500.0))
def _less_when_quick(x, p, s, c):
    """p: share lost at most, time constant s, µs/s at which half is lost. s: width before, mean speed of change."""
    s[1] += (abs(c[WIDTH_US] - s[0]) / c[STEP_S] - s[1]) * (1.0 - math.exp(-c[STEP_S] / p[1]))
    s[0] = c[WIDTH_US]
    return x * (1.0 - p[0] * s[1] / (s[1] + p[2]))


# History-dependent force: after a high torque some of it lingers (or is missing) at the next lower one.
@OUTSIDERS["residual_force"].form(
    "residual force enhancement or depression", "Abbott and Aubert 1952; Herzog 2004, transposed to activation"
)
@draws("gain", 0.95, "share", decay_s=(8.0, 40.0), sign=Sign())
def _residual(x, p, s, c):
    """p: share, decay s. s[0]: highest torque of this contraction, released only by full relaxation."""
    if c[ACTIVATION] < 0.02:
        s[1] += c[STEP_S]
        if s[1] > 0.4:
            s[0] *= math.exp(-c[STEP_S] / 0.05)
    else:
        s[1] = 0.0
    s[0] = max(s[0] * math.exp(-c[STEP_S] / p[1]), x)
    return x + p[0] * (s[0] - x) * (1.0 if c[ACTIVATION] > 0.02 else 0.0)


# Sensor gain that swings: warmth from a heating cycle changes the load cell's sensitivity, not its zero.
@OUTSIDERS["sensor_gain_swing"].form("sensitivity swings in time", "heating cycle; made to be foreign")
@draws("sensor", 0.8, "depth", period_s=(3.0, 9.0), _phase=(0.0, 2.0 * math.pi), sharpness=(0.2, 4.0))
def _swing(x, p, s, c):
    wave = math.sin(2.0 * math.pi * c[TIME_S] / p[1] + p[2])
    return x * (1.0 + p[0] * math.tanh(p[3] * wave) / math.tanh(p[3]))


# A slipped electrode: at one moment it comes away from its place, and from then on everything is weaker or later.
MOMENTS_S = ((5.0, 12.0), (14.7, 17.7), (19.0, 25.0))
"""Within the PRBS, between it and the ramp, within the ramp of a full test."""


def _moment(rng, _base):
    return float(rng.uniform(*MOMENTS_S[int(rng.integers(len(MOMENTS_S)))]))


@OUTSIDERS["slipped_electrode"].form("the gain steps once", "electrode slip")
@draws("gain", 0.7, "size", moment_s=_moment, sign=Sign(weighted(0.7, 0.3)))
def _gain_step(x, p, s, c):
    return x * max(1.0 + p[0], 0.0) if c[TIME_S] >= p[1] else x


@OUTSIDERS["slipped_electrode"].form("the threshold steps once", "electrode slip")
@draws("electrode", 90.0, "size_us", moment_s=_moment, sign=Sign(weighted(0.3, 0.7)))
def _threshold_step(x, p, s, c):
    return max(x - p[0], 0.0) if x > 0.0 and c[TIME_S] >= p[1] else x


def _both_step(size: float, moment_s: float, us_per_size: float, state: tuple[float, ...]) -> list[Stage]:
    threshold = _threshold_step.build(size * us_per_size, moment_s, state=state)
    return threshold + _gain_step.build(-size, moment_s, state=state)


OUTSIDERS["slipped_electrode"].form("gain and threshold step once", "electrode slip")(
    Form(_both_step, 0.7, "size", {"moment_s": _moment, "us_per_size": (30.0, 90.0)})
)


# A slow converter: the sensor holds each reading for a while, or rounds it coarsely.
@OUTSIDERS["slow_converter"].form("each reading is held", "sample and hold")
@draws("converter", 1.2, "held_s")
def _sample_and_hold(x, p, s, c):
    """p: how long a reading is held, s. s: reading, time of the next."""
    if c[TIME_S] >= s[1]:
        s[0] = x
        s[1] += p[0]
    return s[0]


@OUTSIDERS["slow_converter"].form("coarse steps", "quantiser")
@draws("converter", 0.6, "step_share")
def _coarse(x, p, s, c):
    step = p[0] * c[LARGEST_NM]
    return round(x / step) * step


# Stick-slip: the limb sticks in the splint and the reading stays, then jumps.
@OUTSIDERS["stick_slip"].form("breakaway and slip", "Coulomb friction with a breakaway torque")
@draws("structure", 0.6, "breakaway_share", sticks_again_share=(0.05, 0.3), slip_s=(0.005, 0.04))
def _stick_slip(x, p, s, c):
    """p: breakaway as a share of the largest torque, share at which it sticks again, slip s. s: reading, slipping."""
    gap = p[0] * c[LARGEST_NM]
    if abs(x - s[0]) > gap:
        s[1] = 1.0
    if s[1] > 0.0:
        s[0] += (x - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
        if abs(x - s[0]) < p[1] * gap:
            s[1] = 0.0
    return s[0]


# Delay that depends on the pulse width: weak pulses answer later (or earlier) than strong ones.
def _late_when(rng, _base):
    sign = weighted(0.7, 0.3)(rng)
    return Numbers((sign,), late_when="strong" if sign > 0 else "weak")


@OUTSIDERS["width_dependent_delay"].form(
    lambda revealed: f"transport line as long as the pulse is {revealed['late_when']}",
    "conduction of small axons; made to be foreign",
)
@draws("delay", 0.25, "delay_range_s", _late_when=_late_when)
def _variable_line(x, p, s, c):
    """p: delay range s, sign. s[0]: place in the ring of 1000; each sample is put where it will come out."""
    size = 1000
    i = int(s[0])
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    late = p[0] * (a if p[1] > 0.0 else 1.0 - a)
    steps = min(int(late / c[STEP_S] + 0.5), 900)
    furthest = min(int(p[0] / c[STEP_S]) + 2, 950)
    for k in range(steps, furthest + 1):
        s[1 + (i + k) % size] = x
    out = s[1 + i % size]
    s[0] = (i + 1) % size
    return out
