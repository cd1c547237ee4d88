"""What is learnt of muscles that no library holds: error on what no fit was given.

    python -m bench.strange --set physics|further|places|plain --seeds 1000:1004

Seeds 0 to 99 were developed on; report on seeds from 1000. Errors are over the noise's standard
deviation, on a second record of the muscle that no fit was given, tared on its first rest.

`--no-names` leaves out `diagnose`, half of the time; then no name counts as untrue.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from bench.common import in_processes, keep, line, parser, table
from bench.muscles.physics_records import DISTURBED, SETS, record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import side_by_side as workers
from tests.harness.carried_sessions import as_record

SURE = 0.9
"""Probability from which a name counts as told for sure."""
WORSE, CLOSE = 1.02, 1.3
PICTURE = {"enters": "where they enter", "driven_by": "what drives them"}
REST_S = 1.9
HEADS = ("record", "plain", "improved", "added", "names and probabilities", "verdict", "seconds")


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def score(made: dict[str, Any], model: identify.Model) -> float:
    """The model's error on what no fit was given, over the noise."""
    unseen = made["unseen"]
    off = identify.predict(model, as_record(unseen)) - unseen["torque_nm"]
    return rms(off - np.mean(off[unseen["time_s"] < REST_S])) / made["truth"]["noise_sd_nm"]


def look(job: tuple[str, int, bool]) -> dict[str, Any]:
    """One record of a set and a seed: its plain fit, `improve` and, where wanted, the names of `diagnose`."""
    kind, seed, with_names = job
    made = record_of_physics(kind, seed)
    workers.WORKERS = 1
    record = as_record(made)
    began = time.perf_counter()
    plain = identify.fit(record)
    improved = identify.improve(record)
    seconds = time.perf_counter() - began
    missing = identify.diagnose(record).missing if with_names else ()
    named = {row["effect"]: row["probability"] for row in missing}
    return {
        "seed": made["truth"]["seed"],
        "kind": made["truth"]["kind"],
        "disturbed": made["truth"]["disturbed"],
        "plain": score(made, plain),
        "improved": score(made, improved.models[-1]),
        "added": [step["added"] for step in improved.steps if step["added"]],
        "named": named,
        "untrue": [name for name, sure in named.items() if sure >= SURE and name not in made["truth"]["true"]],
        "verdict": improved.verdict,
        "pictured": pictured(made, improved.models[-1]),
        "seconds": seconds,
    }


def pictured(made: dict[str, Any], model: identify.Model) -> dict[str, Any]:
    """By `PICTURE`: what the first free effect of a model says, and what would be right; empty without one."""
    found = next((effect["shape"] for effect in model.effects if "shape" in effect), None)
    truth = made["truth"]
    if found is None:
        return {}
    return {key: (found[key], truth[key]) for key in PICTURE}


def tell_pictures(rows: list[dict[str, Any]]) -> Iterable[str]:
    """In how many a picture is right, beside the one answer that would be right most often, always given."""
    told = [row["pictured"] for row in rows if row["pictured"]]
    for key, words in PICTURE.items() if told else ():
        right = sum(said in truth for said, truth in (one[key] for one in told))
        words_there = {word for one in told for word in one[key][1]}
        always = max((sum(word in one[key][1] for one in told) for word in words_there), default=0)
        yield f"free effects {len(told)}: {words} right in {right}; with the best one word every time {always}"


def tell(kind: str, rows: list[dict[str, Any]]) -> Iterable[str]:
    """The summary."""
    plain, improved = (np.array([row[name] for row in rows]) for name in ("plain", "improved"))
    yield f"median error over noise: plain {np.median(plain):.2f}, improved {np.median(improved):.2f}"
    yield f"within {CLOSE} ×: plain {np.sum(plain <= CLOSE)}, improved {np.sum(improved <= CLOSE)} of {len(rows)}"
    yield f"improved worse than plain by over 2 %: {np.sum(improved > WORSE * plain)} of {len(rows)}"
    yield f"improved better by 10 % and more: {np.sum(improved <= 0.9 * plain)} of {len(rows)}"
    yield from tell_pictures(rows)
    yield f"records with a name that is untrue with {SURE} and more: {sum(bool(row['untrue']) for row in rows)}"
    if kind == "plain":
        asked = [(row, one) for row in rows for one in row["disturbed"] if DISTURBED[one]]
        told = sum(DISTURBED[one] in {*row["added"], *row["named"]} for row, one in asked)
        yield f"hum and slow zero told: {told} of {len(asked)}"


def cells(row: dict[str, Any]) -> list[str]:
    """A record's line."""
    over = f" + {', '.join(row['disturbed'])}" if row["disturbed"] else ""
    names = ", ".join(f"{name} {sure:.2f}" for name, sure in row["named"].items())
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
    """Make, fit, improve, tell."""
    made = parser(__doc__, "1000:1004")
    made.add_argument("--set", choices=SETS, required=True)
    made.add_argument("--no-names", action="store_true", help="without `diagnose`: half the time")
    made.add_argument("--jobs", type=int, default=1, help="processes")
    asked = made.parse_args()
    jobs = [(asked.set, seed, not asked.no_names) for seed in asked.seeds]
    found = in_processes(look, jobs, asked.jobs) if asked.jobs > 1 else map(look, jobs)
    rows = []
    print(*table(HEADS, []), sep="\n", flush=True)
    for row in found:
        rows.append(row)
        print(line(cells(row)), flush=True)
    print(f"\n{asked.set}, seeds {asked.seeds.start} to {asked.seeds.stop - 1}", *tell(asked.set, rows), sep="\n")
    keep(asked.json, rows)


if __name__ == "__main__":
    main()
