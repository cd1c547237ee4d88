"""Hidden patients on the wire, through REST alone: test, compare, diagnose, next experiment, add, and what was hidden.

    python -m bench.hidden_on_the_wire --seeds 1000:1008
    python -m bench.hidden_on_the_wire --moving --seeds 2520:2540

`--moving`: patients whose joint moves, with an angle sensor; one test, sealed, read and diagnosed, and beside it the
same patient's record as a CSV file (`bench/hidden_moving_played.py`). `--hiding`: only the seeds among them that
hide this effect, asked before they are played.

Every seed counts. `--speed` lets emulator and rig run faster than real time (a busy machine makes the result noisy).
`bench/hidden_played.py` plays one seed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from bench.hidden_moving_played import DESIGN
from bench.hidden_moving_played import run as run_moving
from bench.hidden_played import reveal, run
from stimrig.api.cli.errors import CommandError
from stimrig.api.client.errors import ServiceError


def main() -> None:
    """Print one line a seed, and how many agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1000:1008", help="first:last, last not included")
    parser.add_argument("--speed", type=float, default=2.0)
    parser.add_argument("--json", type=Path, help="write all that was found here")
    parser.add_argument("--moving", action="store_true", help="patients whose joint moves")
    parser.add_argument("--hiding", help="with --moving: only seeds that hide this effect")
    options = parser.parse_args()
    first, _, last = options.seeds.partition(":")
    seeds = list(range(int(first), int(last or int(first) + 1)))
    if options.hiding:
        seeds = [seed for seed in seeds if options.hiding in reveal(seed, *DESIGN)["effects"]]
    rows = _moving(seeds, options.speed) if options.moving else _still(seeds, options.speed)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


def _still(seeds: list[int], speed: float) -> list[dict[str, Any]]:
    rows = []
    for seed in seeds:
        try:
            with tempfile.TemporaryDirectory(prefix="hidden-") as folder:
                row = run(seed, speed, Path(folder))
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
    return rows


def _moving(seeds: list[int], speed: float) -> list[dict[str, Any]]:
    """Rows, printed as they come, and the totals of each effect on the wire and as a file."""
    rows = []
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="moving-") as folder:
            row = run_moving(seed, speed, Path(folder))
        rows.append(row)
        told = {where: f"{row[where]['verdict']}: {', '.join(row[where]['named']) or '-'}" for where in ("wire", "csv")}
        print(
            f"{seed}  hidden {'+'.join(row['hidden']) or 'nothing'} ({row['strength']})  wire {told['wire']}  "
            f"csv {told['csv']}  pulses late {row['lateness_ms']} ms, {row['dropped_pulses']} dropped",
            flush=True,
        )
    for effect in sorted({"+".join(row["hidden"]) for row in rows}):
        of_it = [row for row in rows if "+".join(row["hidden"]) == effect]
        right = {where: sum(row[where]["agrees"] for row in of_it) for where in ("wire", "csv")}
        first = {where: sum(row[where]["named_first"] for row in of_it) for where in ("wire", "csv")}
        print(
            f"{effect or 'nothing'}: right {right['wire']} of {len(of_it)} on the wire, {right['csv']} as a file; "
            f"named first {first['wire']} and {first['csv']}"
        )
    return rows


if __name__ == "__main__":
    main()
