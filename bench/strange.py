"""Score what `improve` learns of muscles that are not in the library, on a record that was not fitted.

    python -m bench.strange --set SET --seeds 1000:1004 [--protocol NAME]

Seeds 0 to 99 were developed on; report on seeds from 1000. Errors are over the noise's standard
deviation, on a second record of the muscle that no fit was given, tared on its first rest.

`--no-names` leaves out `diagnose`, half of the time; then no name counts as untrue. `--again` joins a second test of
the rested muscle: the one that the product asks for, or the same one again. The plain model stays that of the first.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from bench.common import bench_parser, in_processes, line, table, write_json
from bench.muscles.physics_records import DISTURBED, FULL, SETS, TESTS, further_record, record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.records.join import join
from stimrig.rig.sequences import build
from tests.harness.carried_sessions import as_record

SURE_PROBABILITY = 0.9
"""Probability from which an effect counts as named for sure."""
WORSE, CLOSE = 1.02, 1.3
REST_S = 1.9
BETWEEN_S = 1200.0
"""From the start of the first test to that of a second one."""
HEADS = ("record", "plain", "improved", "added", "names and probabilities", "verdict", "seconds")


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def score(generated: dict[str, Any], model: identify.Model) -> float:
    """Return the model's error on the unseen record, over the noise."""
    unseen = generated["unseen"]
    off = identify.predict(model, as_record(unseen)) - unseen["torque_nm"]
    return rms(off - np.mean(off[unseen["time_s"] < REST_S])) / generated["truth"]["noise_sd_nm"]


def with_second(kinds: str, generated: dict[str, Any], again: str) -> identify.Record:
    """Return the first record joined with a second: `chosen` by the product, if it asks for one, or the `same`."""
    first, truth = as_record(generated), generated["truth"]
    width_us = first.pulse_width_us[:: round(first.sample_rate_hz / first.pulse_rate_hz)]
    if again == "chosen":
        experiment = identify.next_experiment(first)
        if experiment is None:
            return first
        widths_us = [build(one["sequence"], dict(one["settings"]), first.pulse_rate_hz) for one in experiment.segments]
        width_us = np.concatenate(widths_us)
    second = further_record(kinds, truth["seed"], tuple(truth["disturbed"]), width_us)
    return join([first, as_record(second)], [0.0, BETWEEN_S])


def identify_record(job: tuple[str, int, str, bool, str]) -> dict[str, Any]:
    """Score one record of a set and a seed: its plain fit, `improve` and, where wanted, the names of `diagnose`."""
    kind, seed, protocol, with_names, again = job
    generated = record_of_physics(kind, seed, protocol=protocol)
    workers.WORKERS = 1
    record = as_record(generated)
    began = time.perf_counter()
    plain = identify.fit(record)
    record = with_second(kind, generated, again) if again else record
    improved = identify.improve(record)
    seconds = time.perf_counter() - began
    missing = identify.diagnose(record).missing if with_names else ()
    named = {row["effect"]: row["probability"] for row in missing}
    sure_names = [name for name, probability in named.items() if probability >= SURE_PROBABILITY]
    return {
        "seed": generated["truth"]["seed"],
        "kind": generated["truth"]["kind"],
        "disturbed": generated["truth"]["disturbed"],
        "plain": score(generated, plain),
        "improved": score(generated, improved.models[-1]),
        "added": [step["added"] for step in improved.steps if step["added"]],
        "named": named,
        "untrue": [name for name in sure_names if name not in generated["truth"]["true"]],
        "verdict": improved.verdict,
        "place": generated["truth"]["place"],
        "term": first_term(improved.models[-1]),
        "seconds": seconds,
    }


def first_term(model: identify.Model) -> dict[str, Any] | None:
    """Return the first term of the model's free effect: its `place` and `driver`; None without one."""
    return next((effect["shape"] for effect in model.effects if "shape" in effect), None)


def place_line(rows: list[dict[str, Any]]) -> str:
    """Count the first terms that stand at the right place, over the muscles that have one."""
    placed = [row for row in rows if row["place"]]
    terms = [row for row in placed if row["term"]]
    right = sum(row["term"]["place"].removeprefix("factor of the ") in row["place"] for row in terms)
    return f"first term at the true place: {right} of {len(placed)} with a true place, {len(terms)} of them with a term"


def summary_lines(kind: str, rows: list[dict[str, Any]]) -> Iterable[str]:
    """Yield the lines of the summary."""
    plain, improved = (np.array([row[name] for row in rows]) for name in ("plain", "improved"))
    yield f"median error over noise: plain {np.median(plain):.2f}, improved {np.median(improved):.2f}"
    yield f"within {CLOSE} ×: plain {np.sum(plain <= CLOSE)}, improved {np.sum(improved <= CLOSE)} of {len(rows)}"
    yield f"improved worse than plain by over 2 %: {np.sum(improved > WORSE * plain)} of {len(rows)}"
    yield f"improved better by 10 % and more: {np.sum(improved <= 0.9 * plain)} of {len(rows)}"
    yield place_line(rows)
    untrue_count = sum(bool(row["untrue"]) for row in rows)
    yield f"records with a name that is untrue with {SURE_PROBABILITY} and more: {untrue_count}"
    if kind == "plain":
        disturbed_rows = [(row, name) for row in rows for name in row["disturbed"] if DISTURBED[name]]
        named_count = sum(DISTURBED[name] in {*row["added"], *row["named"]} for row, name in disturbed_rows)
        yield f"hum and slow zero told: {named_count} of {len(disturbed_rows)}"


def cells(row: dict[str, Any]) -> list[str]:
    """A record's line."""
    over = f" + {', '.join(row['disturbed'])}" if row["disturbed"] else ""
    names = ", ".join(f"{name} {probability:.2f}" for name, probability in row["named"].items())
    return [
        f"{row['seed']} {row['kind']}{over}",
        f"{row['plain']:.2f}",
        f"{row['improved']:.2f}",
        ", ".join(row["added"]) or "–",
        names or "–",
        row["verdict"],
        f"{row['seconds']:.1f}",
    ]


def main() -> None:
    """Score every record and print the table."""
    parser = bench_parser(__doc__, "1000:1004")
    parser.add_argument("--set", choices=SETS, required=True)
    parser.add_argument("--protocol", choices=TESTS, default=FULL, help="test of the first record")
    parser.add_argument("--no-names", action="store_true", help="without `diagnose`: half the time")
    parser.add_argument("--again", choices=("chosen", "same"), default="", help="join a second test")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args()
    jobs = [(options.set, seed, options.protocol, not options.no_names, options.again) for seed in options.seeds]
    results = in_processes(identify_record, jobs, options.jobs) if options.jobs > 1 else map(identify_record, jobs)
    rows = []
    print(*table(HEADS, []), sep="\n", flush=True)
    for row in results:
        rows.append(row)
        print(line(cells(row)), flush=True)
    second = f" and {options.again} again" if options.again else ""
    title = (
        f"\n{options.set}, protocol {options.protocol}{second}, seeds {options.seeds.start} to {options.seeds.stop - 1}"
    )
    print(title, *summary_lines(options.set, rows), sep="\n")
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
