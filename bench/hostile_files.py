"""`python -m bench.hostile_files [--count N] [--seed S] [--json]`: files as weapons, through the service's own workers.

Printed: how many were tried, refused in one clear line, taken as sound, and how many ended in a crash or an error that
nobody expected (none is wanted); the workers' peak memory and the longest time. `tests/harness/hostile_files.py` tries
them, `tests/harness/hostile_shapes.py` makes them.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from dataclasses import asdict

from bench.common import parser
from tests.harness.hostile_files import run
from tests.harness.hostile_shapes import all_files


def main() -> int:
    """Run; 1 where something was not as it should be."""
    made = parser(__doc__)
    made.add_argument("--count", type=int, default=400)
    made.add_argument("--seed", type=int, default=9)
    made.add_argument("--json", action="store_true")
    options = made.parse_args()
    logging.disable(logging.WARNING)  # each refusal would be a line
    tally = asyncio.run(
        run(lambda folder: all_files(folder, options.seed, options.count), lambda line: print(line, file=sys.stderr))
    )
    if options.json:
        print(json.dumps(asdict(tally)))
    else:
        print(
            f"{tally.tried} files ({', '.join(f'{n} {kind}' for kind, n in tally.kinds.items())}), seed {options.seed}"
        )
        print(f"refused in one line {tally.refused}, taken as sound {tally.sound}, worker died {tally.died}")
        print(f"peak memory {tally.peak_mb:g} MB ({tally.peak_by}), longest {tally.longest_s} s ({tally.longest_by})")
        print("\n".join(["not as it should be:", *tally.failed]) if tally.failed else "all as it should be")
    return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(main())
