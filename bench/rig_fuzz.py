"""A million requests at the gate, most of them invalid: no pulse outside the limits may be felt.

    python -m bench.rig_fuzz [--requests N] [--plans N] [--seed N]

`tests/harness/limits_fuzz.py` makes and judges them.
"""

from __future__ import annotations

import argparse
import sys
import time

from tests.harness.limits_fuzz import fuzz, fuzz_plans


def main() -> None:
    """Fuzz and print; exit 1 if a pulse came out that should not have."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--requests", type=int, default=1_000_000)
    parser.add_argument("--plans", type=int, default=20_000)
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
    sys.exit(1 if found.outside or plans.outside else 0)


if __name__ == "__main__":
    main()
