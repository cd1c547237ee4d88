"""An adaptive test with a bank of models against one from nothing, on the same simulated patients with the same noise.

    python -m bench.bank --seeds 1000:1040 [--kinds sigmoid,shaped] [--workers 2] [--json FILE]

Patients and noise are those of `bench.adaptive`; seeds below 100 were developed on. A bank's models come from adaptive
tests of their own, with their own noise. Rows: from nothing; a bank of this person's model of another day alone; the
same among 19 of others; 20 others, as they come; 20 others, each at least `FAR` spreads away. The other day has
another gain (sd 20 %), threshold (8 µs), width (8 %) and speed (8 %). Spread: what usually changes from day to day.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from bench.adaptive import KINDS, LONGEST_S, NOISE_NM, TARGET, covered_by, paper_test, unseen_percent
from bench.common import in_processes, keep_lines, lines_of, parser, table
from stimrig import identify
from stimrig.identify.estimation.earlier import USUAL
from stimrig.identify.experiments.bank import UNLIKE, Bank
from stimrig.identify.model import Model
from tests.harness.adaptive import Muscle, Played, play, recorded

POOL, BANK = 26, 20
"""People whose models are at hand, half of each kind, and models in a bank."""
POOL_SEEDS = 500_000
"""Added to the first seed: the pool's people are none of the patients."""
FAR = 6.0
ROWS = ("from nothing", "own", "own among others", "others", "unlike all")


def noise_of(seed: int, which: int) -> np.ndarray:
    """White noise at 400 Hz, N·m."""
    return np.random.default_rng([seed, which]).standard_normal(int((LONGEST_S + 30.0) * 400)) * NOISE_NM


def limits(muscle: Muscle) -> dict[str, Any]:
    """Time and torque-time as in `bench.adaptive`."""
    return {"left_s": LONGEST_S / 2.0, "left_nm_s": float(np.sum(muscle.curve(paper_test(muscle.top_us)[0]))) / 40.0}


def model_of(made: Played, bank: Bank | None = None) -> Model:
    """The model that a test leaves, fitted with that of the bank which the person was found to be like."""
    assert made.record is not None
    weighed = made.decision.weighed
    like = {} if bank is None else {one.name: one.model for one in bank.candidates}
    earlier = None if weighed is None else like.get(weighed.name)
    known: dict[str, Any] = {} if earlier is None else {"earlier": earlier}
    return identify.fit(made.record, recruitment="near-sigmoid", **known)


def marks(muscle: Muscle) -> np.ndarray:
    """Log gain, middle, log width, log T and log damping, in spreads."""
    u = np.arange(muscle.top_us + 1.0)
    share = muscle.curve(u) / muscle.curve(muscle.top_us)
    low, middle, high = (float(u[np.argmax(share >= part)]) for part in (0.1, 0.5, 0.9))
    logs = np.log([float(muscle.curve(muscle.top_us)), max(high - low, 1.0), muscle.time_constant_s, muscle.damping])
    sd = [USUAL.gain_log, USUAL.middle_us, USUAL.width_log, USUAL.time_constant_log, USUAL.damping_log]
    return np.array([logs[0], middle, *logs[1:]]) / np.array(sd)


def pool_member(job: tuple[str, int]) -> str:
    """The model of one of the pool's people, as JSON."""
    kind, seed = job
    muscle = KINDS[kind](seed)
    return model_of(play(muscle, noise_of(seed, 5), TARGET, **limits(muscle))).to_json()


def banks(muscle: Muscle, own: Model, pool: list[tuple[str, int, Model]], seed: int) -> dict[str, Bank]:
    """The banks of the rows, in a random order."""
    rng = np.random.default_rng([seed, 10])
    here = marks(muscle)
    away = [float(np.linalg.norm(marks(KINDS[kind](number)) - here)) for kind, number, _ in pool]
    order = rng.permutation(len(pool))

    def bank(places: Any, **more: Model) -> Bank:
        return Bank.of({f"{pool[i][0]} {pool[i][1]}": pool[i][2] for i in places} | more)

    return {
        "own": bank([], own=own),
        "own among others": bank(order[: BANK - 1], own=own),
        "others": bank(order[:BANK]),
        "unlike all": bank([i for i in order if away[i] >= FAR][:BANK]),
    }


def row(name: str, muscle: Muscle, made: Played, bank: Bank | None, seed: int, spent_s: list[float]) -> dict[str, Any]:
    """One line of the results."""
    known, weighed = made.decision.knowledge, made.decision.weighed
    curve, step, band = covered_by(known, muscle) if known is not None else (False, False, float("nan"))
    model = model_of(made, bank)
    return {
        "row": name, "seed": seed, "ended": made.decision.kind, "dose": made.dose_nm_s(muscle),
        "charge_us": float(np.sum(made.widths_us)), "seconds": made.seconds, "curve_covered": curve,
        "step_covered": step, "band": band, "unseen_percent": 100.0 - unseen_percent(muscle, model.predict, seed),
        "unseen_noise": unseen_noise(muscle, model, seed), "like": weighed.name if weighed else "", "cpu_s": spent_s,
        "models": 0 if weighed is None else len(weighed.names),
    }  # fmt: skip


def unseen_noise(muscle: Muscle, model: Model, seed: int) -> float:
    """Error of the clean torque of random levels, divided by the noise of a sample."""
    levels = np.random.default_rng([seed, 7]).uniform(0.0, muscle.top_us, 30)
    widths = np.r_[np.zeros(40), np.repeat(levels, 20)]
    record = recorded(muscle, widths, ["validate"] * widths.size, np.zeros(20000), 400.0)
    return float(np.sqrt(np.mean((record.torque_nm - model.predict(record)) ** 2))) / NOISE_NM


def one(job: tuple[str, int, list[tuple[str, int, str]], str]) -> list[dict[str, Any]]:
    """All rows of one patient."""
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    kind, seed, texts, wanted = job
    pool = [(name, number, Model.from_json(text)) for name, number, text in texts]
    muscle = KINDS[kind](seed)
    day = muscle.another_day(np.random.default_rng([seed, 8]))
    own = model_of(play(day, noise_of(seed, 6), TARGET, **limits(day)))
    rows = []
    for name, bank in {ROWS[0]: None, **banks(muscle, own, pool, seed)}.items():
        if name not in wanted.split("; ") and name != ROWS[0]:
            continue
        spent_s: list[float] = []

        def timed(call: Any, spent: list[float] = spent_s) -> Any:
            began = time.process_time()
            found = call()
            spent.append(round(time.process_time() - began, 3))
            return found

        known: dict[str, Any] = {} if bank is None else {"bank": bank}
        made = play(muscle, noise_of(seed, 5), TARGET, timed=timed, **limits(muscle), **known)
        rows.append({"kind": kind} | row(name, muscle, made, bank, seed, spent_s))
    for line in rows:
        for key, share in (("dose", "dose_share"), ("charge_us", "charge_share"), ("seconds", "time_share")):
            line[share] = line[key] / rows[0][key]
    print(seed, kind, *(f"{r['dose_share']:.2f}" for r in rows), file=sys.stderr, flush=True)
    return rows


def told(rows: list[dict[str, Any]]) -> list[str]:
    """The table."""
    heads = "patients; test; n; torque-time; of all; charge; time, s; time; unseen error / noise; f covered; "
    heads += "step covered; enough; recognised"
    cells = []
    for kind in [*dict.fromkeys(line["kind"] for line in rows), "all"]:
        for name in dict.fromkeys(line["row"] for line in rows):
            own = [line for line in rows if line["row"] == name and kind in (line["kind"], "all")]
            first = [line for line in rows if line["row"] == ROWS[0] and kind in (line["kind"], "all")]
            mid = {key: float(np.median([line[key] for line in own])) for key in own[0] if key.endswith("_share")}
            total = sum(line["dose"] for line in own) / sum(line["dose"] for line in first)
            percents = [
                f"{100 * mid['dose_share']:.0f} %",
                f"{100 * total:.0f} %",
                f"{100 * mid['charge_share']:.0f} %",
            ]
            seconds = [f"{np.median([r['seconds'] for r in own]):.1f}", f"{100 * mid['time_share']:.0f} %"]
            unseen = f"{np.median([r['unseen_noise'] for r in own]):.2f}"
            right = {"own": "own", "own among others": "own"}.get(name, UNLIKE)
            counts = [sum(r[key] for r in own) for key in ("curve_covered", "step_covered")]
            counts += [sum(r["ended"] == "enough" for r in own), sum(r["like"] == right for r in own)]
            shares = [f"{count} ({100 * count / len(own):.0f} %)" for count in counts]
            cells.append([kind, name, len(own), *percents, *seconds, unseen, *shares[: 3 if name == ROWS[0] else 4]])
            cells[-1] += [""] * (13 - len(cells[-1]))
    return table(heads.split("; "), cells)


def main() -> None:
    """Print the table."""
    made = parser(__doc__, "1000:1040")
    made.add_argument("--kinds", default="sigmoid,shaped")
    made.add_argument("--tests", default="; ".join(ROWS), help="those beside the one from nothing")
    made.add_argument("--workers", type=int, default=2)
    made.add_argument("--rows", type=Path, help="print the table of rows that were written before")
    settings = made.parse_args()
    if settings.rows is not None:
        rows = lines_of(settings.rows)
        print(*told(rows), *told_of_time(rows), sep="\n")
        return
    kinds = settings.kinds.split(",")
    first = POOL_SEEDS + settings.seeds.start
    people = [(("sigmoid", "shaped")[i % 2], first + i) for i in range(POOL)]
    texts = list(in_processes(pool_member, people, settings.workers))
    pool = [(*person, text) for person, text in zip(people, texts, strict=True)]
    jobs = [(kind, seed, pool, settings.tests) for seed in settings.seeds for kind in kinds]
    rows: list[dict[str, Any]] = []
    for found in in_processes(one, jobs, settings.workers):
        rows += found
        keep_lines(settings.json, rows)
    print(*told(rows), sep="\n")
    print(*told_of_time(rows), sep="\n")


def told_of_time(rows: list[dict[str, Any]]) -> list[str]:
    """Processor time of a decision."""
    cpu = {
        name: np.concatenate([line["cpu_s"][1:] for line in rows if line["row"] == name])
        for name in dict.fromkeys(line["row"] for line in rows)
    }
    found = {name: 1e3 * np.quantile(seconds, [0.5, 0.99]) for name, seconds in cpu.items()}
    return [
        f"`decide`, {name}: {half:.0f} ms of processor time, p99 {most:.0f} ms." for name, (half, most) in found.items()
    ]


if __name__ == "__main__":
    main()
