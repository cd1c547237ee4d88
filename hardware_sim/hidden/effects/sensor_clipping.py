"""Sensor clipping: the load cell's amplifier or converter reaches its rail."""

from __future__ import annotations

from stimrig.hardware_sim.hidden.forms import Effect, draws
from stimrig.hardware_sim.hidden.kernels import LARGEST_NM, TIME_S

EFFECT = Effect()


@EFFECT.form("upper rail", "textbook")
@draws("converter", 0.8, "share_cut_off")
def _rail(x, p, s, c):
    return min(x, (1.0 - p[0]) * c[LARGEST_NM])


@EFFECT.form("upper and lower rail", "textbook")
@draws("converter", 0.8, "share_cut_off", lower_rail_share=(0.05, 0.3))
def _both_rails(x, p, s, c):
    return max(min(x, (1.0 - p[0]) * c[LARGEST_NM]), -p[1] * c[LARGEST_NM])


@EFFECT.form("converter at its last code", "textbook")
@draws("converter", 0.8, "share_cut_off", counts=lambda rng, _base: int(rng.choice([2047, 4095, 8191])))
def _converter(x, p, s, c):
    """p: share cut off, counts up to the rail. A coarse-ish converter whose code stops at its end."""
    rail = (1.0 - p[0]) * c[LARGEST_NM]
    count = rail / p[1]
    return min(float(round(x / count)), p[1]) * count


@EFFECT.held_back("the amplifier stays at its rail a little longer", "overload recovery")
@draws("converter", 0.8, "share_cut_off", stays_s=(0.005, 0.03))
def _overload(x, p, s, c):
    """p: share of the largest torque cut off, s the amplifier stays at the rail. s[0]: until when."""
    rail = (1.0 - p[0]) * c[LARGEST_NM]
    if x >= rail:
        s[0] = c[TIME_S] + p[1]
    return rail if c[TIME_S] <= s[0] and s[0] > 0.0 else x
