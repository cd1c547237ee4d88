"""Potentiation: a muscle that has just worked gives more torque for the same recruitment."""

from __future__ import annotations

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import ACTIVATION, FORCE, LARGEST_NM, PULSE, STEP_S

EFFECT = Effect("larger")


def _decay_per_s(rng, _base):
    return 1.0 / float(rng.uniform(15.0, 80.0))


@EFFECT.form("light-chain phosphorylation", "Sweeney, Bowman and Stull 1993; sizes of O'Leary, Hope and Sale 1997")
@draws("gain", 1.2, "full_gain", kinase_per_s=(0.06, 0.4), phosphatase_per_s=_decay_per_s)
def _phosphorylation(x, p, s, c):
    """p: gain at full phosphorylation, rates of kinase and phosphatase per s. s[0]: phosphorylated share."""
    s[0] += c[STEP_S] * (p[1] * c[ACTIVATION] * (1.0 - s[0]) - p[2] * s[0])
    return x * (1.0 + p[0] * s[0])


@EFFECT.form("staircase, pulse by pulse", "treppe, Bowditch 1871; MacIntosh 2010")
@draws("gain", 1.2, "full_gain", share_a_pulse=(0.004, 0.02), decay_s=(10.0, 60.0))
def _staircase(x, p, s, c):
    """p: gain at the end, what a pulse adds of what is left, decay s. s[0]: height of the staircase."""
    if c[PULSE] > 0.0 and c[ACTIVATION] > 0.03:
        s[0] += p[1] * (1.0 - s[0])
    s[0] -= c[STEP_S] * s[0] / p[2]
    return x * (1.0 + p[0] * s[0])


@EFFECT.form("leftward shift of the force-calcium curve", "Persechini, Stull and Cooke 1985")
@draws("gain", 15.0, "shift", kinase_per_s=(0.08, 0.4), phosphatase_per_s=_decay_per_s)
def _calcium_sensitivity(x, p, s, c):
    """p: shift of the force-calcium curve, rates per s. Much at low activation, nothing at full activation."""
    a = min(max(c[ACTIVATION], 0.0), 1.0)
    s[0] += c[STEP_S] * (p[1] * a * (1.0 - s[0]) - p[2] * s[0])
    shift = p[0] * s[0]
    share = x / c[LARGEST_NM]
    if share >= 1.0:
        return x
    return c[LARGEST_NM] * share * (1.0 + shift) / (1.0 + shift * share)


@EFFECT.held_back("two stores filled by force", "biexponential decay of potentiation, O'Leary, Hope and Sale 1997")
@draws("gain", 1.5, "gain", build_up_s=(2.5, 8.0), fast_decay_s=(8.0, 20.0), slow_decay_s=(40.0, 120.0))
def _by_work(x, p, s, c):
    """p: gain, build-up s, two decays s. s: two stores filled by force."""
    fill = c[STEP_S] * max(c[FORCE], 0.0) / p[1]
    s[0] += fill * (1.0 - s[0]) - c[STEP_S] * s[0] / p[2]
    s[1] += fill * (1.0 - s[1]) - c[STEP_S] * s[1] / p[3]
    return x * (1.0 + p[0] * (0.5 * s[0] + 0.5 * s[1]) ** 1.3)
