"""The behaviour suite on every pair: 2 stimulators x 5 cells x 2 transports, through the emulator.

python -m bench.rig_pairs [--speed N]

A pair fails, too, where a figure passes its bound. A machine with other work on it, or whose processors are taken away,
passes it by its own doing.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path

from bench.common import line, parser, table
from tests.harness.device_pairs import CELLS, STIMULATORS, TRANSPORTS, check_all, options
from tests.harness.processes import Bench

COLUMNS = {
    "align_ms": ("alignment ms", 1.0),
    "ack_ms": ("acknowledged ms", 10.0),
    "stop_ms": ("stop ms", 100.0),
    "fault_ms": ("unheard ms", 250.0),
    "silence_ms": ("host killed ms", 30.0),
    "dropped_percent": ("dropped %", 10.0),
}
"""Each figure's title and bound."""


def main() -> None:
    """Run and print one line for each pair; exit 1 if one fails."""
    made = parser(__doc__)
    made.add_argument("--speed", type=float, default=2.0)
    speed, failed = made.parse_args().speed, 0
    print(*table(["stimulator", "cell", "transport", *(title for title, _ in COLUMNS.values())], []), sep="\n")
    for pair in itertools.product(STIMULATORS, CELLS, TRANSPORTS):
        with tempfile.TemporaryDirectory(prefix="rig-pairs-") as folder:
            bench = Bench(Path(folder), *options(*pair), speed=speed)
            try:
                found = check_all(bench)
                cells = [f"{found[k]:.2f}" for k in COLUMNS]
                over = [name for name, (_, bound) in COLUMNS.items() if not found[name] <= bound]
                assert not over, f"over its bound: {' '.join(over)}: {' '.join(cells)}"
            except (AssertionError, TimeoutError, RuntimeError) as error:
                failed += 1
                cells = ["FAILED: " + " ".join(str(error).split())[:200]]
            finally:
                bench.close()
        print(line([*pair, *cells]), flush=True)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
