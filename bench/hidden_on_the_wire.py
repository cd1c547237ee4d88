"""Hidden patients on the wire, through REST alone: test, compare, diagnose, next experiment, add, and what was hidden.

    python -m bench.hidden_on_the_wire --seeds 1000:1008

Every seed counts. `--speed` lets emulator and rig run faster than real time (a busy machine makes the result noisy).
`tests/harness/hidden_on_the_wire.py` plays one seed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from api.cli.errors import CommandError
from api.client.errors import ServiceError
from tests.harness.hidden_on_the_wire import run


def main() -> None:
    """Print one line a seed, and how many agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1000:1008", help="first:last, last not included")
    parser.add_argument("--speed", type=float, default=2.0)
    parser.add_argument("--json", type=Path, help="write all that was found here")
    options = parser.parse_args()
    first, _, last = options.seeds.partition(":")
    rows = []
    for seed in range(int(first), int(last or int(first) + 1)):
        try:
            with tempfile.TemporaryDirectory(prefix="hidden-") as folder:
                row = run(seed, options.speed, Path(folder))
        except (CommandError, ServiceError) as error:
            rows.append({"seed": seed, "agrees": False, "error": str(error)})
            print(f"{seed}  FAILED: {error}", flush=True)
            continue
        rows.append(row)
        hidden = "+".join(row["hidden"]) or "nothing"
        print(
            f"{seed}  hidden {hidden} ({row['strength']}{', outside' if row['outside_library'] else ''})  "
            f"verdict {row['verdict']}: {', '.join(row['named']) or '-'}  before the experiment "
            f"{', '.join(row['named_before_experiment']) or '-'}  error/noise {row['times_noise']}  "
            f"pulses late {row['lateness_ms']} ms, {row['dropped_pulses']} dropped  "
            f"{'agrees' if row['agrees'] else 'DIFFERS'}",
            flush=True,
        )
    print(f"{sum(row['agrees'] for row in rows)} of {len(rows)} agree")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
