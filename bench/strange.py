"""What is learnt of muscles that no library holds, and of records as they are: error on what no fit was given.

    python -m bench.strange --set physics|further|places|arms|idle|sealed|plain --seeds 1000:1004

Seeds 0 to 99 were developed on; report on seeds from 1000. Of `sealed` only sums are told: nobody who tunes should
learn what is in it. Errors are over the noise's standard deviation, on a second record of the muscle that no fit was
given, tared on its first rest; those of arms over the error of plain repetition, the mean of the other ramps.

`--no-names` leaves out `diagnose`, half of the time; then no name counts as untrue. `--only-plain` leaves out
`improve`, too, and takes a second a record.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np

from bench.common import in_processes, keep, line, parser, table
from bench.muscles.bout_records import Peculiar, record_of_bouts
from bench.muscles.physics_records import DISTURBED, SETS, record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.estimation.uncertainty import POINTWISE, prediction_band
from tests.harness.carried_sessions import as_record

SURE = 0.9
"""Probability from which a name counts as told for sure."""
WORSE, CLOSE = 1.02, 1.3
PICTURE = {"enters": "where they enter", "driven_by": "what drives them"}
ARMS = ("arms", "idle")
"""Records of bouts; the stimulator of `idle` goes on below threshold between them."""
TRUE_OF_ARMS = {"mixed_fibres", "baseline_drift"}
REST_S = 1.9
HEADS = ("record", "plain", "improved", "added", "names and probabilities", "verdict", "seconds")


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def make(kind: str, seed: int) -> dict[str, Any]:
    """A record of the set, with `kind`, and `true`: names that are no mistake."""
    made = record_of_bouts(seed, Peculiar(idle=kind == "idle")) if kind in ARMS else record_of_physics(kind, seed)
    made["true"] = TRUE_OF_ARMS if kind in ARMS else set(made["truth"]["true"])
    made["kind"] = made["truth"].get("kind", kind)
    return made


def score(made: dict[str, Any], model: identify.Model) -> float:
    """The model's error on what no fit was given, over that of plain repetition, or over the noise."""
    if "unseen" not in made:
        unseen, repetition = repeated(made)
        predicted = identify.predict(model, as_record(made))[unseen]
        return rms(made["torque_nm"][unseen] - predicted) / rms(made["torque_nm"][unseen] - repetition)
    unseen = made["unseen"]
    off = identify.predict(model, as_record(unseen)) - unseen["torque_nm"]
    return rms(off - np.mean(off[unseen["time_s"] < REST_S])) / made["truth"]["noise_sd_nm"]


def stated(made: dict[str, Any], model: identify.Model) -> float:
    """The standard deviation that the model states of its prediction of the second record, over the noise."""
    lower, upper = prediction_band(model, as_record(made["unseen"]))
    return rms(upper - lower) / (2.0 * POINTWISE * made["truth"]["noise_sd_nm"])


def repeated(made: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the unseen ramp and its decay, and the mean of the other three there."""
    bouts = [np.flatnonzero(made["bout"] == made["bout"][-1] - back) for back in range(4)]
    count = min(map(len, bouts))
    return bouts[0][:count], np.mean([made["torque_nm"][rows[:count]] for rows in bouts[1:]], axis=0)


def look(job: tuple[str, int, Collection[str]]) -> dict[str, Any]:
    """One record of a set and a seed: its plain fit and, of `improve` and `diagnose`, what is in `steps`."""
    kind, seed, steps = job
    made = make(kind, seed)
    workers.WORKERS = 1
    record = as_record(made)
    began = time.perf_counter()
    plain = identify.fit(record)
    improved = identify.improve(record) if "improve" in steps else None
    seconds = time.perf_counter() - began
    named = (
        {row["effect"]: row["probability"] for row in identify.diagnose(record).missing} if "diagnose" in steps else {}
    )
    row = {
        "seed": made["truth"]["seed"],
        "kind": made["kind"],
        "disturbed": made["truth"].get("disturbed", []),
        "plain": score(made, plain),
        "improved": score(made, improved.models[-1] if improved else plain),
        "stated": stated(made, improved.models[-1] if improved else plain) if "unseen" in made else 0.0,
        "added": [step["added"] for step in (improved.steps if improved else ()) if step["added"]],
        "named": named,
        "untrue": [name for name, sure in named.items() if sure >= SURE and name not in made["true"]],
        "verdict": improved.verdict if improved else "",
        "pictured": pictured(made, improved.models[-1] if improved else plain),
        "phi": plain.noise.ar1,
        "white_nm": plain.noise.white_sd_nm,
        "seconds": seconds,
    }
    if kind == "sealed":
        row |= {"kind": "", "added": len(row["added"]), "named": {}, "untrue": ["?" for _ in row["untrue"]]}
        row |= {"verdict": ""}
    return row


def pictured(made: dict[str, Any], model: identify.Model) -> dict[str, Any]:
    """By `PICTURE`: what the first free effect of a model says, and what would be right; empty without one."""
    found = next((effect["shape"] for effect in model.effects if "shape" in effect), None)
    truth = made["truth"]
    if found is None or "enters" not in truth:
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
    unit = "plain repetition" if kind in ARMS else "noise"
    yield f"median error over {unit}: plain {np.median(plain):.2f}, improved {np.median(improved):.2f}"
    yield f"within {CLOSE} ×: plain {np.sum(plain <= CLOSE)}, improved {np.sum(improved <= CLOSE)} of {len(rows)}"
    yield f"improved worse than plain by over 2 %: {np.sum(improved > WORSE * plain)} of {len(rows)}"
    beyond = np.sum(improved > plain + [max(row["stated"], 0.02 * row["plain"]) for row in rows])
    yield f"… and by more than the standard error that it states of itself: {beyond} of {len(rows)}"
    yield f"improved better by 10 % and more: {np.sum(improved <= 0.9 * plain)} of {len(rows)}"
    yield from tell_pictures(rows)
    yield f"records with a name that is untrue with {SURE} and more: {sum(bool(row['untrue']) for row in rows)}"
    if kind in ARMS:
        held = sum(row["phi"] > 0.985 for row in rows), sum(row["phi"] > 0.9939 for row in rows)
        yield f"plain repetition worse than plain by over 2 %: {np.sum(plain * WORSE < 1.0)} of {len(rows)}"
        yield f"slow noise's φ above 0.985 in {held[0]}, at 0.994 in {held[1]}"
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
    made.add_argument("--set", choices=[*SETS, *ARMS], required=True)
    made.add_argument("--no-names", action="store_true", help="without `diagnose`: half the time")
    made.add_argument("--only-plain", action="store_true", help="without `improve`, too")
    made.add_argument("--jobs", type=int, default=1, help="processes")
    asked = made.parse_args()
    steps = () if asked.only_plain else ("improve",) if asked.no_names else ("improve", "diagnose")
    jobs = [(asked.set, seed, steps) for seed in asked.seeds]
    found = in_processes(look, jobs, asked.jobs) if asked.jobs > 1 else map(look, jobs)
    rows = []
    if asked.set != "sealed":
        print(*table(HEADS, []), sep="\n", flush=True)
    for row in found:
        rows.append(row)
        if asked.set != "sealed":
            print(line(cells(row)), flush=True)
    print(f"\n{asked.set}, seeds {asked.seeds.start} to {asked.seeds.stop - 1}", *tell(asked.set, rows), sep="\n")
    if asked.set == "sealed":  # names and physics would tell what is in it
        rows = [row | {"pictured": {}} for row in rows]
    keep(asked.json, rows)


if __name__ == "__main__":
    main()
