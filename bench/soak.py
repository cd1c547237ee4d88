"""A long session in real time on the emulated rig, with fits in another process; figures: docs/results/soak.md.

    python -m bench.soak [--minutes 60] [--every-minutes 5] [--no-fit]

`tests/harness/soak.py` plays it.
"""

from __future__ import annotations

import json
import sys

from bench.common import bench_parser
from tests.harness.soak import soak


def main() -> None:
    """Run and print; exit 1 where a sample was lost or a test did not complete."""
    parser = bench_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--every-minutes", type=float, default=5.0)
    parser.add_argument("--no-fit", action="store_true")
    options = parser.parse_args()
    figures = soak(options.minutes, options.every_minutes, not options.no_fit)
    print(json.dumps(figures, indent=1))
    sys.exit(0 if figures["lost_samples"] == 0 and figures["completed"] == figures["tests"] else 1)


if __name__ == "__main__":
    main()
