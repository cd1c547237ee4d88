"""What the diagnosis says of muscles with something hidden: tables, confusions, calibration; see docs/diagnosis.md.

    python -m bench.diagnosis --seeds 1003:1004 [--only single,nothing,…] [--json FILE]

Seeds 0 to 99 were developed on; report on seeds from 1000. The records come from the emulator's physics, whose
equations are not the library's. Each set is scored as the goals of issue 4 ask.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from identify.diagnosis import candidates as workers
from identify.diagnosis import diagnose
from identify.effects import registry
from identify.records.record import Record

STRENGTHS = ("weak", "middle", "strong")
PAIRS = (
    "fatigue+asymmetric_relaxation",
    "electromechanical_delay+threshold_drift",
    "baseline_drift+activation_dependent_speed",
    "potentiation+mixed_fibres",
    "voluntary_effort+output_saturation",
    "tremor+catch_like",
    "mains_hum+fatigue",
    "recruitment_hysteresis+series_compliance",
)


def as_record(made: dict[str, Any]) -> Record:
    """A generated record as the diagnosis takes it."""
    return Record.from_arrays(
        made["time_s"],
        made["pulse_width_us"],
        made["torque_nm"],
        made["segment"],
        angle_rad=made.get("angle_rad"),
        velocity_rad_s=made.get("velocity_rad_s"),
    )


def one(job: tuple[str, str, int, dict[str, Any]]) -> dict[str, Any] | None:
    """One record diagnosed; None where the generator can't make it."""
    from hardware_sim.hidden_records import generate

    workers.WORKERS = 1
    effect, strength, seed, options = job
    names = tuple(effect.split("+")) if effect else None
    try:
        made = generate(names, strength, seed, **options)
    except ValueError:
        return None
    began, cpu = time.perf_counter(), time.process_time()
    result = diagnose(as_record(made))
    first = result.missing[0] if result.missing else None
    noise = result.noise_sd_nm
    return {
        "effect": effect,
        "strength": strength,
        "seed": seed,
        "options": options,
        "truth": made["truth"]["effects"],
        "formulation": made["truth"]["formulation"],
        "verdict": result.verdict,
        "named": [entry["effect"] for entry in result.missing],
        "probability": first["probability"] if first else result.probability,
        "group": [first["effect"], *first["confused_with"]] if first else [],
        "before": result.base["held_out_rms_nm"],
        "after": result.with_all["held_out_rms_nm"],
        "noise": noise,
        "explained": result.explained,
        "structure": result.structure_left,
        "gains": [(c["effect"], c["form"], c["log_evidence_gain"]) for c in result.candidates[0][:4]],
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
    }


def jobs(kind: str, seeds: Iterable[int]) -> list[tuple[str, str, int, dict[str, Any]]]:
    """What a set is made of."""
    from hardware_sim.patients.hidden.draw import effect_ids, outside_ids

    seeds = list(seeds)
    if kind == "single":
        return [(e, s, seed, {}) for e in effect_ids() for s in STRENGTHS for seed in seeds]
    if kind == "slow":
        return [(e, s, seed, {"noise": "slow"}) for e in effect_ids() for s in STRENGTHS[1:] for seed in seeds[:1]]
    if kind == "outside":
        return [(e, s, seed, {}) for e in outside_ids() for s in STRENGTHS[1:] for seed in seeds]
    if kind == "two":
        return [(pair, "middle", seed, {}) for pair in PAIRS for seed in seeds]
    if kind == "rates":
        sets: list[dict[str, Any]] = [{"rate_hz": r} for r in (100, 1600)] + [
            {"with_validate": False},
            {"design": "short"},
        ]
        chosen = ("fatigue", "asymmetric_relaxation", "electromechanical_delay", "output_saturation", "catch_like")
        return [(e, "middle", seed, options) for e in chosen for options in sets for seed in seeds[:1]]
    if kind == "nothing":
        many = range(min(seeds), min(seeds) + 12 * len(seeds))
        sets = [{}, {"noise": "ar1"}, {"steep": True}, {"noise": "slow"}]
        return [("", "middle", seed, options) for options in sets for seed in many]
    raise SystemExit(f"no set {kind!r}")


def share(flags: list[bool]) -> str:
    """A proportion with its count."""
    return f"{100 * np.mean(flags):.0f} % ({sum(flags)}/{len(flags)})" if flags else "none"


def tell(kind: str, rows: list[dict[str, Any]]) -> None:
    """The figures of a set."""
    if kind in ("single", "slow", "rates"):
        for strengths in (("middle", "strong"), ("weak",)):
            some = [r for r in rows if r["strength"] in strengths]
            if some:
                print(f"  named first, {' and '.join(strengths)}: {share([_first(r) for r in some])}")
                print(f"  named first or in its group: {share([_grouped(r) for r in some])}")
                print(f"  verdict 'effect missing': {share([r['verdict'] == 'effect_missing' for r in some])}")
        _calibration(rows)
        gone = [_removed(r) for r in rows if _first(r) and r["before"] > 1.2 * r["noise"] and _foreseeable(r)]
        if gone:
            median = 100 * np.median(gone)
            print(f"  held-out error above noise removed, efforts and tremor aside: median {median:.0f} %")
        _confusions(rows)
    elif kind == "nothing":
        by: dict[str, list[bool]] = defaultdict(list)
        for r in rows:
            by[json.dumps(r["options"])].append(r["verdict"] == "nothing_missing")
        for options, flags in by.items():
            print(f"  nothing missing, {options}: {share(flags)}")
    elif kind == "outside":
        print(f"  structure left: {share([r['verdict'] == 'unexplained_structure' for r in rows])}")
        for effect in sorted({r["effect"] for r in rows}):
            some = [r for r in rows if r["effect"] == effect]
            said = Counter(r["verdict"] if r["verdict"] != "effect_missing" else r["named"][0] for r in some)
            print(f"    {effect}: {dict(said)}")
    elif kind == "two":
        print(f"  both named: {share([set(r['truth']) <= set(r['named']) for r in rows])}")
        print(f"  one named: {share([bool(set(r['truth']) & set(r['named'])) for r in rows])}")
        for r in rows:
            print(f"    {r['effect']} {r['seed']}: {r['named']} {r['verdict']}")
    cpu = [r["cpu_seconds"] for r in rows]
    print(f"  processor seconds a record: median {np.median(cpu):.1f}, largest {max(cpu):.1f}")


def _first(row: dict[str, Any]) -> bool:
    return row["named"][:1] == row["truth"][:1]


def _grouped(row: dict[str, Any]) -> bool:
    return bool(set(row["truth"]) & set(row["group"]))


def _foreseeable(row: dict[str, Any]) -> bool:
    """Efforts and tremor can be seen and not foreseen: no model takes their error away from rows it has not seen."""
    effect = registry()[row["truth"][0]]
    return effect.foreseeable and not effect.band


def _removed(row: dict[str, Any]) -> float:
    excess = [np.sqrt(max(row[key] ** 2 - row["noise"] ** 2, 0.0)) for key in ("before", "after")]
    return 1.0 - excess[1] / max(excess[0], 1e-9)


def _calibration(rows: list[dict[str, Any]]) -> None:
    named = [r for r in rows if r["named"] and r["verdict"] == "effect_missing"]
    for low, high in ((0.0, 0.6), (0.6, 0.85), (0.85, 0.97), (0.97, 1.01)):
        some = [r for r in named if low <= r["probability"] < high]
        if some:
            stated = np.mean([r["probability"] for r in some])
            print(f"  stated {low:g} to {min(high, 1):g} (mean {stated:.2f}): right {share([_first(r) for r in some])}")


def _confusions(rows: list[dict[str, Any]]) -> None:
    wrong = Counter((r["truth"][0], r["named"][0] if r["named"] else r["verdict"]) for r in rows if not _first(r))
    for (truth, named), count in wrong.most_common():
        print(f"    {truth} named {named}: {count}")


def run(arguments: list[str] | None = None) -> None:
    """Make, diagnose, tell."""
    parser = argparse.ArgumentParser(prog="python -m bench.diagnosis", description=__doc__)
    parser.add_argument("--seeds", default="1003:1004", help="first:last, last not included")
    parser.add_argument("--only", default="single,nothing,outside,two,slow,rates")
    parser.add_argument("--json", type=Path, default=None)
    settings = parser.parse_args(arguments)
    first, last = (int(part) for part in settings.seeds.split(":"))
    everything = {}
    with ProcessPoolExecutor(2) as pool:
        for kind in settings.only.split(","):
            rows = [row for row in pool.map(one, jobs(kind, range(first, last))) if row is not None]
            print(f"{kind}, seeds {first} to {last - 1}, {len(rows)} records")
            tell(kind, rows)
            sys.stdout.flush()
            everything[kind] = rows
            if settings.json is not None:
                settings.json.write_text(json.dumps(everything, default=float))


if __name__ == "__main__":
    run()
