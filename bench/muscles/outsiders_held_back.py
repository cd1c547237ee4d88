"""Effects no library names, kept from whoever tunes the diagnosis; only the bench's set `kept` draws them.

Their names tell nothing, on purpose. Don't read this while working on `identify`.
"""

from __future__ import annotations

import math

from numpy.random import Generator

from stimrig.hardware_sim.hidden.base import Base, delayed, second_order_step
from stimrig.hardware_sim.hidden.forms import Effect, Numbers, Sign, draws, even, largest_width_us, weighted
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, STEP_S, TIME_S, WIDTH_US, uniform

OUTSIDERS_HELD_BACK: dict[str, Effect] = {}

# A stretch reflex of the splinted limb: a rise of torque is answered a moment later by a pull, one way only.
KIND_A = OUTSIDERS_HELD_BACK["kind_a"] = Effect()


def _answered(rng: Generator, _base: Base) -> Numbers:
    sign = even(rng)
    return Numbers((sign,), answers="rise" if sign > 0 else "fall")


@KIND_A.form(
    "delayed reflex to a quick change of torque",
    "stretch reflex with threshold and delay, Kearney, Stein and Parameswaran 1997, transposed to torque",
)
@draws(
    "additive",
    0.6,
    "gain_s",
    delay_s=(0.04, 0.12),
    _speed=lambda rng, _base: 1.0 / float(rng.uniform(0.03, 0.12)),
    threshold_per_s=(0.1, 0.4),
    _answered=_answered,
    pull=Sign(weighted(0.6, 0.4)),
)
def _reflex(x, p, s, c):
    """p: torque per (largest torque a second), delay s, 1/Tω, threshold 1/s, sign. s: filter, x before, ring of 900."""
    size = 900
    rate = (x - s[2]) / (c[LARGEST_NM] * c[STEP_S])
    s[2] = x
    i = int(s[3])
    s[10 + i] = max(rate * p[4] - p[3], 0.0)
    s[3] = (i + 1) % size
    late = min(int(p[1] / c[STEP_S] + 0.5), size - 1)
    drive = s[10 + (i - late) % size]
    return x + p[0] * c[LARGEST_NM] * second_order_step(drive, p[2], 1.0, s, 0, c[STEP_S])


# A stimulator that takes up a new setting only now and then: for some pulses the old width is still sent.
KIND_B = OUTSIDERS_HELD_BACK["kind_b"] = Effect()


@KIND_B.form("settings are taken up now and then", "a slow link between computer and stimulator")
@draws("electrode", 0.6, "mean_time_s", seed_at=2, spread=[0.0, 0.2, 0.8])
def _stale(x, p, s, c):
    """p: mean time between settings s, spread. s: width in force, time of the next setting, generator."""
    if p[0] <= 0.0:
        return x
    if c[TIME_S] >= s[1]:
        s[0] = x
        s[1] += p[0] * (1.0 + p[1] * (2.0 * uniform(s, 2) - 1.0))
    return s[0]


# A stimulator with a soft start: its pulse width rises (or also falls) only so quickly, whatever is asked.
KIND_C = OUTSIDERS_HELD_BACK["kind_c"] = Effect()


@KIND_C.form("the width is slewed", "soft start of clinical stimulators")
@draws("electrode", 2.0, "up_s", down_share=[0.0, 0.5, 1.0], _largest=largest_width_us)
def _slewed(x, p, s, c):
    """p: s for the largest width up and down as a share of it, largest width µs. s[0]: width in force."""
    up = p[2] * c[STEP_S] / max(p[0], 1e-9)
    down = p[2] * c[STEP_S] / max(p[0] * p[1], 1e-9)
    s[0] += min(max(x - s[0], -down), up)
    return s[0]


# Stimulation current that gets into the load cell's amplifier: the reading goes up with the width, at once.
KIND_D = OUTSIDERS_HELD_BACK["kind_d"] = Effect()


@KIND_D.form("artefact proportional to the width", "stimulus artefact in a bridge amplifier")
@draws("sensor", 1.0, "share", sign=Sign(), _largest=largest_width_us)
def _feed_through(x, p, s, c):
    """p: share with its sign, largest width µs."""
    return x + p[0] * c[LARGEST_NM] * c[WIDTH_US] / p[1]


@KIND_D.form("artefact at changes of the width", "stimulus artefact through a coupling capacitor")
@draws("sensor", 1.5, "share", sign=Sign(), _largest=largest_width_us, decay_s=(0.05, 0.4))
def _edges(x, p, s, c):
    """p: share with its sign, largest width µs, decay s. s: the amplifier's slow copy of the artefact."""
    drive = c[WIDTH_US] / p[1]
    s[0] += (drive - s[0]) * (1.0 - math.exp(-c[STEP_S] / p[2]))
    return x + p[0] * c[LARGEST_NM] * (drive - s[0])


# An amplifier that seeks its own zero: the zero follows what is read, always or while little is read.
KIND_E = OUTSIDERS_HELD_BACK["kind_e"] = Effect()


@KIND_E.form("the zero follows the reading", "high-pass coupling of a bridge amplifier")
@draws("sensor", 1.0, "rate_per_s")
def _coupled(x, p, s, c):
    """p: rate 1/s. s[0]: zero. Coupled through a capacitor."""
    out = x - s[0]
    s[0] += p[0] * c[STEP_S] * out
    return out


@KIND_E.form("the zero follows small readings", "zero tracking of weighing indicators")
@draws("sensor", 4.0, "rate_per_s", window_share=(0.2, 0.6))
def _tracking(x, p, s, c):
    """p: rate 1/s, window as a share. s[0]: zero. It follows only what lies within the window."""
    out = x - s[0]
    window = p[1] * c[LARGEST_NM]
    if abs(out) < window:
        s[0] += p[0] * c[STEP_S] * out
    return out


# A slack strap: the first torque only takes up the slack, and is read late or hardly at all.
KIND_F = OUTSIDERS_HELD_BACK["kind_f"] = Effect()


@KIND_F.form("slack", "dead zone")
@draws("structure", 0.6, "slack_share")
def _dead(x, p, s, c):
    """p: slack as a share of the largest torque."""
    slack = p[0] * c[LARGEST_NM]
    return max(x - slack, 0.0) if x > 0.0 else x


@KIND_F.form("toe", "toe region of webbing")
@draws("structure", 1.5, "toe_share")
def _toe(x, p, s, c):
    """p: toe as a share of the largest torque: quadratic below, straight above."""
    toe = p[0] * c[LARGEST_NM]
    if x <= 0.0 or toe <= 0.0:
        return x
    return x * x / (2.0 * toe) if x < toe else x - 0.5 * toe


# Two clocks that do not agree: the torque's time runs away from the stimulator's.
KIND_G = OUTSIDERS_HELD_BACK["kind_g"] = Effect()


@KIND_G.form("the delay grows with time", "two free-running crystals; setting them alike now and then")
@draws(
    "structure",
    lambda revealed: 0.012 if revealed["set_alike_after_s"] > 1e5 else 0.025,
    "s_per_s",
    set_alike_after_s=lambda rng, _base: float(rng.choice([1e6, rng.uniform(9.0, 20.0)])),
)
def _running_away(x, p, s, c):
    """p: s a s, time after which the clocks are set alike again s. s[0]: place in the ring of 1000."""
    return delayed(x, min(p[0] * (c[TIME_S] % p[1]) / c[STEP_S], 990.0), s, 10, 1000)
