# ruff: noqa: ARG001 (every kernel takes the same four arguments)
"""A slack strap: the first torque only takes up the slack, and is read late or hardly at all."""

from __future__ import annotations

from stimrig.hardware_sim.patients.hidden.kernels import LARGEST_NM, kernel
from stimrig.hardware_sim.patients.hidden.written import Written


@kernel("structure")
def _dead(x, p, s, c):
    """p: slack as a share of the largest torque."""
    slack = p[0] * c[LARGEST_NM]
    return max(x - slack, 0.0) if x > 0.0 else x


@kernel("structure")
def _toe(x, p, s, c):
    """p: toe as a share of the largest torque: quadratic below, straight above."""
    toe = p[0] * c[LARGEST_NM]
    if x <= 0.0 or toe <= 0.0:
        return x
    return x * x / (2.0 * toe) if x < toe else x - 0.5 * toe


FORMULATIONS = (
    Written("slack", "dead zone", _dead, 0.6, "slack_share"),
    Written("toe", "toe region of webbing", _toe, 1.5, "toe_share"),
)
