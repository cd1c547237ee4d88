"""Muscles that change over a session, for the benches of tracking: drawn by seed; and what changes, by case."""

from __future__ import annotations

from typing import Any

import numpy as np

FIRST_TRIAL = 2
"""The pre-session test is a muscle's first contraction."""
NOTHING = "nothing changes"
DISTURBED_TRIAL = 5
PEAK_SHARE = 0.4
"""The reference's peak, of the largest torque: a muscle that has lost 40 % of it can still reach it."""

# The test before the trials tires, too: with this share of fatigue 40 % of the gain are lost from the begin of the
# first trial to the end of the tenth.
CASES = {
    NOTHING: {},
    "fatigue": {"fatigue_share": 0.55, "fatigue_recovery_s": 600.0},
    "potentiation": {"potentiation_share": 0.3},
    "threshold drift": {"drift_us": 15.0},
    "slow change of speed": {"slowing_share": 0.3},
    "spasm in trial 5": {"spasm_contraction": FIRST_TRIAL + DISTURBED_TRIAL - 1},
    "effort in trial 5": {"effort_contraction": FIRST_TRIAL + DISTURBED_TRIAL - 1},
}


def patient(seed: int, case: str) -> dict[str, Any]:
    """Parameters of `hardware_sim.patients.changing` for a muscle and a case; the muscle is the same in each case."""
    rng = np.random.default_rng([seed, 14])
    largest_nm = float(rng.uniform(3.0, 12.0))
    muscle = {
        "largest_nm": largest_nm,
        "threshold_us": float(rng.uniform(40.0, 110.0)),
        "spread_us": float(rng.uniform(50.0, 120.0)),
        "shape": float(rng.uniform(1.3, 3.0)),
        "natural_period_s": float(rng.uniform(0.12, 0.45)),
        "damping_ratio": float(rng.uniform(0.6, 1.1)),
        "spasm_nm": largest_nm * float(rng.uniform(0.15, 0.4)),
        "spasm_begins_s": float(rng.uniform(2.0, 8.0)),
        "spasm_lasts_s": float(rng.uniform(0.2, 1.5)),
        "effort_nm": largest_nm * float(rng.uniform(0.1, 0.25)),
        "effort_begins_s": float(rng.uniform(1.0, 5.0)),
        "effort_lasts_s": float(rng.uniform(2.0, 5.0)),
    }
    sign = 1.0 if rng.random() < 0.7 else -1.0
    changes = {name: sign * value if name == "drift_us" else value for name, value in CASES[case].items()}
    return muscle | changes
