"""A line that stalls for 5 ms to 2 s, in every direction and phase of a test, on both stimulators.

    python -m bench.rig_stalls [--cases N] [--seed N] [--stimulators p24 rehastim2]

`tests/harness/stalls.py` plays and judges the cases.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.harness.stalls import INTERVAL_S, Case, stalls

DURATIONS_S = (0.005, 0.01, 0.02, 0.04, 0.07, 0.09, 0.12, 0.2, 0.4, 0.8, 1.5, 2.0)
DIRECTIONS = ("to_device", "to_host", "both")
PHASES = ("arming", "hold", "three in a row", "ramp", "end")


def cases(stimulator: str) -> list[Case]:
    """Every duration in every direction and phase, with and without a stop."""
    grid = itertools.product(DURATIONS_S, DIRECTIONS, PHASES, (False, True))
    return [Case(stimulator, *each) for each in grid]


def summary(found: list[Case]) -> str:
    """Figures in a few lines."""
    stops = [case for case in found if case.confirmed is not None]
    finite = [case.shortest_s for case in found if np.isfinite(case.shortest_s)]
    short = sum(case.shortest_s < INTERVAL_S for case in found)
    unconfirmed = [case for case in stops if not case.confirmed]
    return "\n".join(
        (
            f"{len(found)} stalled tests, {sum(case.felt for case in found)} pulses felt, "
            f"{sum(case.dropped for case in found)} dropped",
            f"tests with a felt interval below {1e3 * INTERVAL_S:g} ms: {short} "
            f"(shortest {1e3 * min(finite, default=float('nan')):.2f} ms)",
            f"stops in a stall: {len(stops)}; pulses felt after the request: at most "
            f"{max((case.after_request for case in stops), default=0)} "
            f"(one in {sum(case.after_request == 1 for case in stops)} of them); after a confirmed answer: "
            f"{sum(case.after_confirmed for case in stops)}; not confirmed: {len(unconfirmed)}",
            f"cases with anything wrong: {sum(bool(case.wrong) for case in found)}",
        )
    )


def main() -> None:
    """Stall, print, exit 1 where anything is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=0, help="so many of the cases of each stimulator; default all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--stimulators", nargs="*", default=["p24", "rehastim2"])
    options = parser.parse_args()

    def told(case: Case) -> None:
        if case.wrong:
            print(json.dumps(case.__dict__), flush=True)

    def play(stimulator: str) -> list[Case]:
        wanted = cases(stimulator)
        random.Random(options.seed).shuffle(wanted)
        return stalls(wanted[: options.cases or None], options.seed, told)

    with ThreadPoolExecutor(len(options.stimulators)) as pool:
        results = dict(zip(options.stimulators, pool.map(play, options.stimulators), strict=True))
    for stimulator, found in results.items():
        print(f"{stimulator}:\n{summary(found)}")
    sys.exit(1 if any(case.wrong for found in results.values() for case in found) else 0)


if __name__ == "__main__":
    main()
