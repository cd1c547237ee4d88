"""A million requests at the gate, most of them invalid: no pulse outside the limits may be felt.

    python -m bench.rig_fuzz [--requests N] [--plans N] [--calibrations N] [--seed N]

`tests/harness/limits_fuzz.py` makes and judges them; `tests/harness/calibration_fuzz.py` does so for guided
calibrations, with steps, marks, stops, faults and lost devices in any order.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time

from tests.harness.calibration_fuzz import fuzz_calibrations
from tests.harness.limits_fuzz import fuzz, fuzz_plans


def main() -> None:
    """Fuzz and print; exit 1 if a pulse came out that should not have."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--requests", type=int, default=1_000_000)
    parser.add_argument("--plans", type=int, default=20_000)
    parser.add_argument("--calibrations", type=int, default=200, help="of 60 actions each")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    began_s = time.monotonic()
    found = fuzz(options.requests, options.seed)
    print(
        f"seed {options.seed}: {found.requests} requests, {found.sent} pulses sent, {found.felt} felt, "
        f"{found.outside} outside, {found.refused_profiles} invalid profiles refused, "
        f"{time.monotonic() - began_s:.0f} s {found.example}"
    )
    plans = fuzz_plans(options.plans, options.seed)
    print(
        f"seed {options.seed}: {plans.requests} whole plans, {plans.sent} admitted, {plans.outside} outside "
        f"{plans.example}"
    )
    logging.disable()  # every fault of a device is logged
    began_s = time.monotonic()
    pressed = fuzz_calibrations(options.calibrations, options.seed)
    print(
        f"seed {options.seed}: {pressed.requests} actions in {options.calibrations} calibrations, {pressed.sent} "
        f"trains let through, {pressed.felt} pulses felt, {pressed.outside} outside, {pressed.refused_profiles} "
        f"invalid starts refused, {time.monotonic() - began_s:.0f} s {pressed.example}"
    )
    sys.exit(1 if found.outside or plans.outside or pressed.outside else 0)


if __name__ == "__main__":
    main()
