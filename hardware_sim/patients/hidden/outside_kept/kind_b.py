"""A stimulator that takes up a new setting only now and then: for some pulses the old width is still sent."""

from __future__ import annotations

from stimrig.hardware_sim.patients.hidden.kernels import TIME_S, kernel, uniform
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("electrode")
def _stale(x, p, s, c):
    """p: mean time between settings s, spread. s: width in force, time of the next setting, generator."""
    if p[0] <= 0.0:
        return x
    if c[TIME_S] >= s[1]:
        s[0] = x
        s[1] += p[0] * (1.0 + p[1] * (2.0 * uniform(s, 2) - 1.0))
    return s[0]


FORMULATIONS = (
    Written(
        "settings are taken up now and then",
        "a slow link between computer and stimulator",
        _stale,
        0.6,
        "mean_time_s",
        {"spread": [0.0, 0.2, 0.8]},
        seed_at=2,
    ),
)
