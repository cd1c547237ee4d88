"""How often the residual tests of `compare` alarm, on exact muscles and on muscles with one hidden effect.

    python -m bench.residual_alarms [--seeds 2000:2100] [--effects fatigue,…] [--workers 1] [--json FILE]

Of each seed three records of a plain muscle: `own`, on which its model was fitted; and of a muscle of
`bench.muscles.physics_records` the fitted one and its `unseen` one, with noise. A record alarms if any test does; the
stated rate is 5 %. With `--effects`, beside them a muscle with each hidden effect, of middle and of strong size.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import Any

import numpy as np

from bench.common import bench_parser, in_processes, table, write_json
from bench.muscles.hidden_records import generate
from bench.muscles.physics_records import NOISE_SD_NM, record_of_physics
from stimrig import identify
from stimrig.identify.criticism import compare
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

EXACT = ("own", "plain physics, own", "plain physics, unseen")
STRENGTHS = ("middle", "strong")
TESTS = ("residual", "u", "u2", "y")


def alarms_of(job: tuple[int, tuple[str, ...]]) -> list[dict[str, Any]]:
    """Return a row for each record of a seed: its kind, seed, and the tests that alarm."""
    seed, effects = job
    record = as_record(generate(None, seed=seed))
    rows = [_row(EXACT[0], seed, identify.fit(record), record)]
    generated = record_of_physics("plain", seed, disturbed=())
    record, unseen = as_record(generated), as_record(generated["unseen"])
    noise_nm = np.random.default_rng([seed, 7]).normal(0.0, NOISE_SD_NM, unseen.time_s.size)
    model = identify.fit(record)
    rows.append(_row(EXACT[1], seed, model, record))
    rows.append(_row(EXACT[2], seed, model, unseen.with_torque(unseen.torque_nm + noise_nm)))
    for effect in effects:
        for strength in STRENGTHS:
            try:
                record = as_record(generate(effect, strength, seed))
            except ValueError:  # this muscle cannot show the effect at this size
                continue
            rows.append(_row(f"{effect}, {strength}", seed, identify.fit(record), record))
    return rows


def _row(kind: str, seed: int, model: Model, record: Record) -> dict[str, Any]:
    tests = compare(model, record).tests["tests"]
    return {"kind": kind, "seed": seed, "alarms": [test["with"] for test in tests if not test["passed"]]}


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return a table: for each kind of record, how many there are, how many alarm, and by which tests."""
    records = Counter(row["kind"] for row in rows)
    alarming = Counter(row["kind"] for row in rows if row["alarms"])
    by_test = Counter((row["kind"], name) for row in rows for name in row["alarms"])
    lines = []
    for kind, count in records.items():
        share = f"{100.0 * alarming[kind] / count:.1f} %"
        lines.append([kind, count, share, *(by_test[kind, name] for name in TESTS)])
    return table(["record", "records", "alarm", *TESTS], lines)


def main() -> int:
    """Measure, and print the table."""
    parser = bench_parser(__doc__, "2000:2100")
    parser.add_argument("--effects", default="", help="ids with commas")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    effects = tuple(filter(None, options.effects.split(",")))
    jobs = [(seed, effects) for seed in options.seeds]
    rows = [row for alarms in in_processes(alarms_of, jobs, options.workers) for row in alarms]
    write_json(options.json, rows)
    print("\n".join(summary(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
