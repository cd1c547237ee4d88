"""What is learnt of muscles that no library holds, and of records as they are: error on what no fit was given.

    python -m bench.strange --set physics|further|places|arms|idle|sealed|plain --seeds 1000:1004 [--nudge]

Seeds 0 to 99 were developed on; report on seeds from 1000. Of `sealed` only sums are told: nobody who tunes should
learn what is in it. Errors are over the noise's standard deviation, on a second record of the muscle that no fit was
given, tared on its first rest; those of arms over the error of plain repetition, the mean of the other ramps.

`--nudge` fits and improves again with every torque × (1 + 1e-9), `--processor` in a process of its own with the
arithmetic of another processor, and both compare. `--no-names` leaves out `diagnose`, half of the time; then no name
counts as untrue. `--second` makes the record that the program chooses after the first, too, and learns from both:
rows then have `second`, the error with both, `again`, that with the same test in place of the chosen one, and `alike`,
without and with it on one more PRBS and ramp, since what it chooses resembles the second record. `--only-plain` leaves
out `improve`, too, and takes a second a record.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Collection, Iterable
from functools import partial
from typing import Any

import numpy as np

from bench.common import ROOT, in_processes, keep, line, parser, table
from bench.muscles.bout_records import Peculiar, record_of_bouts
from bench.muscles.physics_records import DISTURBED, SETS, alike_record, further_record, record_of_physics
from stimrig import identify
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.diagnosis.free import searched
from stimrig.identify.diagnosis.result import diagnosis_of
from stimrig.identify.diagnosis.search import helpful
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.left_out import difference, leave_out
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.estimation.uncertainty import POINTWISE, prediction_band
from stimrig.identify.records.join import join
from stimrig.rig.sequences import build
from tests.harness.carried_sessions import as_record

NUDGE = 1.0 + 1e-9
OTHER_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NUMBA_CPU_NAME": "haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
SURE = 0.9
"""Probability from which a name counts as told for sure."""
WORSE, CLOSE, MOVES = 1.02, 1.3, 0.01
SEEN = 0.2
"""What noise and floor add to the square of an error on left-out parts: two tenths, as ten samples make an interval."""
PICTURE = {"enters": "where they enter", "driven_by": "what drives them"}
ARMS = ("arms", "idle")
"""Records of bouts; the stimulator of `idle` goes on below threshold between them."""
TRUE_OF_ARMS = {"mixed_fibres", "baseline_drift"}
REST_S = 1.9
PAUSE_S = 1200.0
"""From the begin of the first record to that of the second, which the muscle begins rested."""
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
    return over_noise(made, "unseen", model)


def over_noise(made: dict[str, Any], which: str, model: identify.Model) -> float:
    """The model's error on the `unseen` or the `alike` record over the noise, counted from its own zero."""
    unseen = made[which]
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


def look(made: dict[str, Any], steps: Collection[str]) -> dict[str, Any]:
    """One record: its plain fit and, of `improve` and `diagnose`, what is in `steps`."""
    workers.WORKERS = 1
    record = as_record(made)
    began = time.perf_counter()
    plain = identify.fit(record)
    improved = identify.improve(record) if "improve" in steps else None
    seconds = time.perf_counter() - began
    named = (
        {row["effect"]: row["probability"] for row in identify.diagnose(record).missing} if "diagnose" in steps else {}
    )
    every = max(round(record.sample_rate_hz / record.pulse_rate_hz), 1)
    own_nm = identify.predict(plain, record)
    fitted = made["segment"] != "validate"
    return {
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
        "left_nm": rms((own_nm - made["torque_nm"])[fitted]),
        "own_nm": own_nm[fitted][::every].tolist(),
    }


def last_model(record: identify.Record) -> tuple[identify.Model, list[str], np.ndarray | None, str, list[float] | None]:
    """The last model of `improve`, its effects, and the pulse widths of the experiment that the program chooses.

    Last, how much the logarithm of the error on left-out parts has fallen with all its effects, and its standard error;
    None where no effect stays.
    """
    search, verdict = searched(*prepare(record))
    row = helpful(search)[0]
    model, foretold = finish("maximum-likelihood", row[-1].fitted), None
    if len(row) > 1:
        seen = difference(leave_out(row[0].fitted), leave_out(row[-1].fitted))
        foretold = [seen.gain, seen.sd]
    chosen = diagnosis_of(search, verdict).deciding_experiment
    if chosen is None:
        return model, search.added, None, "", foretold
    played = [build(one["sequence"], dict(one["settings"]), record.pulse_rate_hz) for one in chosen["segments"]]
    return model, search.added, np.concatenate(played), chosen["text"].partition(" (")[0], foretold


def look_twice(made: dict[str, Any], kinds: str) -> dict[str, Any]:
    """One record, and both together: the first and the one that the program chose."""
    workers.WORKERS = 1
    record, began = as_record(made), time.perf_counter()
    first, added, width_us, words, foretold = last_model(record)
    row = {name: made["truth"][name] for name in ("seed", "disturbed")} | {"kind": made["kind"]}
    row |= {"plain": score(made, identify.fit(record)), "improved": score(made, first), "second": score(made, first)}
    row |= {"added": added, "named": {}, "untrue": [], "verdict": words or "nothing chosen", "stated": 0.0}
    row |= {"pictured": pictured(made, first), "foretold": foretold}
    made = made | {"alike": alike_record(kinds, row["seed"])}
    row["alike"] = [over_noise(made, "alike", first)] * 3
    if width_us is not None:
        every = round(record.sample_rate_hz / record.pulse_rate_hz)
        same_again = made["pulse_width_us"][made["segment"] != "validate"][::every]
        made_of = partial(further_record, kinds, row["seed"], tuple(row["disturbed"]))
        both, again = (
            last_model(join([record, as_record(made_of(chosen_us))], [0.0, PAUSE_S]))
            for chosen_us in (width_us, same_again)
        )
        row |= {"added": both[1], "second": score(made, both[0]), "again": score(made, again[0])}
        row["alike"][1:] = [over_noise(made, "alike", one[0]) for one in (both, again)]
    return row | {"seconds": time.perf_counter() - began, "own_nm": []}


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


def elsewhere(made: dict[str, Any], steps: Collection[str]) -> dict[str, Any]:
    """The same record, to the last bit, in a process of its own with another processor's arithmetic."""
    command = [sys.executable, "-c", "from bench.strange import answer; answer()"]
    environment = os.environ | OTHER_PROCESSOR
    done = subprocess.run(command, input=pickle.dumps((made, steps)), env=environment, stdout=-1, check=True, cwd=ROOT)
    return json.loads(done.stdout)


def answer() -> None:
    """What `elsewhere` asks for: a record on standard input, its row on standard output."""
    print(json.dumps(look(*pickle.load(sys.stdin.buffer)), default=float))


def moved(row: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """How far the plain fit moved on its own rows, over what it leaves, and whether other effects were added."""
    shift = rms(np.subtract(row["own_nm"], other["own_nm"])) / row["left_nm"]
    return {"moved": shift, "other": sorted(row["added"]) != sorted(other["added"]), "added": other["added"]}


def compared(job: tuple[str, int, Collection[str], Collection[str]]) -> dict[str, Any]:
    """One record, and `again` with a nudge or by another processor."""
    kind, seed, steps, again = job
    made = make(kind, seed)
    row = look_twice(made, kind) if "second" in again else look(made, steps)
    once_more = [step for step in steps if step != "diagnose"]
    if "nudge" in again:
        row["nudge"] = moved(row, look(made | {"torque_nm": made["torque_nm"] * NUDGE}, once_more))
    if "processor" in again:
        row["processor"] = moved(row, elsewhere(made, once_more))
    del row["own_nm"]
    if kind == "sealed":
        row |= {"kind": "", "added": len(row["added"]), "named": {}, "untrue": ["?" for _ in row["untrue"]]}
        row |= {"verdict": ""} | {again: row[again] | {"added": []} for again in ("nudge", "processor") if again in row}
    return row


def tell_second(rows: list[dict[str, Any]], improved: np.ndarray, second: list[float]) -> Iterable[str]:
    """What the chosen record teaches of levels, and of PRBS and ramp; and the same test in its place."""
    close = f"within {CLOSE} × {np.sum(np.array(second) <= CLOSE)} of {len(rows)}"
    worse = np.sum(np.array(second) > WORSE * improved)
    yield f"with the record that the program chose: {np.median(second):.2f}, {close}, worse by over 2 %: {worse}"
    same_test = [row.get("again", row["improved"]) for row in rows]
    yield f"with the same test again in its place: {np.median(same_test):.2f}"
    first, both, same = np.array([row["alike"] for row in rows]).T
    medians, worse = [f"{np.median(one):.2f}" for one in (first, both, same)], np.sum(both > WORSE * first)
    yield f"on one more PRBS and ramp: {medians[0]}, then {medians[1]}, worse by over 2 %: {worse}; or {medians[2]}"


def tell_promise(rows: list[dict[str, Any]]) -> Iterable[str]:
    """How far the error fell on left-out parts, beside the unseen record."""
    came = 0.5 * np.log([(row["plain"] ** 2 + SEEN) / (row["improved"] ** 2 + SEEN) for row in rows])
    gain, sd = np.array([row["foretold"] for row in rows]).T
    fell, fallen = (100.0 * (1.0 - np.exp(-np.median(one))) for one in (gain, came))
    short = np.sum(came < gain - 2.0 * sd)
    yield f"error on left-out parts falls by {fell:.0f} %, on the unseen record by {fallen:.0f} % (medians);"
    yield f"… by less, and by over two standard errors, in {short} of {came.size}"


def tell(kind: str, rows: list[dict[str, Any]]) -> Iterable[str]:
    """The summary."""
    plain, improved = (np.array([row[name] for row in rows]) for name in ("plain", "improved"))
    second = [row["second"] for row in rows if "second" in row]
    promised = [row for row in rows if row.get("foretold")]
    unit = "plain repetition" if kind in ARMS else "noise"
    yield f"median error over {unit}: plain {np.median(plain):.2f}, improved {np.median(improved):.2f}"
    yield f"within {CLOSE} ×: plain {np.sum(plain <= CLOSE)}, improved {np.sum(improved <= CLOSE)} of {len(rows)}"
    if second:
        yield from tell_second(rows, improved, second)
    if promised:
        yield from tell_promise(promised)
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
    for again in ("nudge", "processor"):
        found = [row[again] for row in rows if again in row]
        if found:
            over = sum(one["moved"] > MOVES for one in found)
            most = max(one["moved"] for one in found)
            other = sum(one["other"] for one in found)
            yield (
                f"{again}: plain fit moves by over 1 % of what it leaves in {over} of {len(found)} (most"
                f" {100.0 * most:.2g} %), other effects in {other}"
            )


def cells(row: dict[str, Any]) -> list[str]:
    """A record's line."""
    over = f" + {', '.join(row['disturbed'])}" if row["disturbed"] else ""
    names = ", ".join(f"{name} {sure:.2f}" for name, sure in row["named"].items())
    return [
        f"{row['seed']} {row['kind']}{over}",
        f"{row['plain']:.2f}",
        f"{row['improved']:.2f}" + (f", {row['second']:.2f}" if "second" in row else ""),
        ", ".join(row["added"]) or "–",
        names or "–",
        row["verdict"],
        f"{row['seconds']:.1f}",
    ]


def main() -> None:
    """Make, fit, improve, tell."""
    made = parser(__doc__, "1000:1004")
    made.add_argument("--set", choices=[*SETS, *ARMS], required=True)
    made.add_argument("--nudge", action="store_true", help="again with every torque × (1 + 1e-9)")
    made.add_argument("--processor", action="store_true", help="again with another processor's arithmetic")
    made.add_argument("--no-names", action="store_true", help="without `diagnose`: half the time")
    made.add_argument("--second", action="store_true", help="one more record, which the program chooses")
    made.add_argument("--only-plain", action="store_true", help="without `improve`, too")
    made.add_argument("--jobs", type=int, default=1, help="processes")
    asked = made.parse_args()
    if asked.second and asked.set in ARMS:
        made.error("--second: not of arms, whose muscle makes no further record")
    steps = () if asked.only_plain else ("improve",) if asked.no_names else ("improve", "diagnose")
    again = [name for name in ("nudge", "processor", "second") if getattr(asked, name)]
    jobs = [(asked.set, seed, steps, again) for seed in asked.seeds]
    found = in_processes(compared, jobs, asked.jobs) if asked.jobs > 1 else map(compared, jobs)
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
