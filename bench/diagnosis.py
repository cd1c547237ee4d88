"""Score the diagnosis on muscles with something hidden: tables, confusions, calibration; see docs/diagnosis.md.

    python -m bench.diagnosis --seeds 1003:1004 [--only single,nothing,…] [--recorder plain,real] [--json FILE]

Seeds 0 to 99 were developed on; report on seeds from 1000. The records come from the emulator's physics, whose
equations are not the library's. Each set is scored as the goals of issue 4 ask. `--recorder` gives the same records as
other recorders do (`bench.muscles.recorders`; `joined`: the patient tested twice, a minute apart), side by
side.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np

from bench.common import bench_parser, in_processes, write_json
from bench.muscles.hidden_records import generate
from bench.muscles.recorders import recorded
from stimrig.hardware_sim.hidden.library import EFFECTS, OUTSIDERS
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.diagnosis.thresholds import NEXT_MARGIN
from stimrig.identify.effects import registry
from stimrig.identify.records.join import join
from stimrig.identify.records.record import Record
from tests.harness.carried_sessions import as_record

SETS = ("single", "nothing", "outside", "two", "slow", "rates")
JOINED_AFTER_S = 60.0
SURE_PROBABILITY = 0.9
"""Probability above which an effect counts as named for sure."""
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


def as_joined(generated: dict[str, Any], kind: str, seed: int) -> Record:
    """Two tests of one patient, each as its own recorder gives it, as one record."""
    time_s = generated["time_s"]
    cut = int(np.argmax(np.diff(time_s))) + 1
    records, begun_s = [], []
    for number, rows in enumerate((slice(0, cut), slice(cut, None))):
        part = {
            key: value[rows] if isinstance(value, np.ndarray | list) and len(value) == time_s.size else value
            for key, value in generated.items()
        }
        part = recorded(part, kind, seed + 2 * number)
        records.append(as_record(part))
        begun_s.append(float(time_s[rows][-1] - part["time_s"][-1]))
    return join(records, begun_s)


def diagnose_record(job: tuple[str, str, int, dict[str, Any]]) -> dict[str, Any] | None:
    """Diagnose one record; None where the generator can't make it."""
    workers.WORKERS = 1
    effect, strength, seed, options = job
    names = tuple(effect.split("+")) if effect else None
    settings = dict(options)
    recorder = settings.pop("recorder", "plain")
    kinds = recorder.split("+")
    if "joined" in kinds:
        settings["again_after_s"] = JOINED_AFTER_S
        kinds.remove("joined")
    try:
        generated, kind = generate(names, strength, seed, **settings), "+".join(kinds) or "plain"
    except ValueError:
        return None
    joined = "again_after_s" in settings
    record = as_joined(generated, kind, seed) if joined else as_record(recorded(generated, kind, seed))
    cpu = time.process_time()
    result = diagnose(record)
    first = result.missing[0] if result.missing else None
    return {
        "effect": effect,
        "strength": strength,
        "seed": seed,
        "options": {key: value for key, value in options.items() if key != "recorder"},
        "recorder": recorder,
        "truth": generated["truth"]["effects"],
        "verdict": result.verdict,
        "named": [entry["effect"] for entry in result.missing],
        "probabilities": [entry["probability"] for entry in result.missing],
        "group": [first["effect"], *first["confused_with"]] if first else [],
        "before": result.base["held_out_rms_nm"],
        "after": result.with_all["held_out_rms_nm"],
        "noise": result.noise_sd_nm,
        "structure said": _reports_structure(result.to_dict()),
        "cpu_seconds": time.process_time() - cpu,
    }


def _reports_structure(result: dict[str, Any]) -> bool:
    """Return true where verdict, figure or words report structure that is left."""
    words = " ".join([*result["conclusion"].values(), *result["notes"]]).lower()
    unexplained = result["verdict"] == "unexplained_structure" or result["structure_left"] > NEXT_MARGIN
    return bool(unexplained or "structure left" in words)


def jobs(kind: str, seeds: Iterable[int]) -> list[tuple[str, str, int, dict[str, Any]]]:
    """Return the records of a set: effect, strength, seed and settings of each."""
    seeds = list(seeds)
    if kind == "single":
        return [(e, s, seed, {}) for e in EFFECTS for s in STRENGTHS for seed in seeds]
    if kind == "slow":
        return [(e, s, seed, {"noise": "slow"}) for e in EFFECTS for s in STRENGTHS[1:] for seed in seeds[:1]]
    if kind == "outside":
        return [(e, s, seed, {}) for e in OUTSIDERS for s in STRENGTHS[1:] for seed in seeds]
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
        many_seeds = range(min(seeds), min(seeds) + 12 * len(seeds))
        sets = [{}, {"noise": "ar1"}, {"steep": True}, {"noise": "slow"}]
        return [("", "middle", seed, options) for options in sets for seed in many_seeds]
    raise SystemExit(f"no set {kind!r}")


def share(flags: list[bool]) -> str:
    """A proportion with its count."""
    return f"{100 * np.mean(flags):.0f} % ({sum(flags)}/{len(flags)})" if flags else "none"


def print_figures(kind: str, rows: list[dict[str, Any]]) -> None:
    """Print the figures of a set, one column a recorder."""
    by: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        by[row["recorder"]].append(row)
    columns = [figures(kind, some) for some in by.values()]
    labels = list(dict.fromkeys(label for column in columns for label in column))
    if len(columns) == 1:
        print("\n".join(f"  {label}: {value}" for label, value in columns[0].items()))
        return
    cells = [["", *by], *([label, *(column.get(label, "-") for column in columns)] for label in labels)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  " + "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def figures(kind: str, rows: list[dict[str, Any]]) -> dict[str, str]:
    """Return the figures of a set by one recorder, as text by label."""
    by_label: dict[str, str] = {"records": str(len(rows))}
    if kind in ("single", "slow", "rates"):
        for strengths in (("middle", "strong"), ("weak",)):
            some = [r for r in rows if r["strength"] in strengths]
            if some:
                which = " and ".join(strengths)
                by_label[f"named first, {which}"] = share([_first(r) for r in some])
                by_label[f"named first or in its group, {which}"] = share(
                    [not {*r["truth"]}.isdisjoint(r["group"]) for r in some]
                )
                by_label[f"verdict 'effect missing', {which}"] = share([r["verdict"] == "effect_missing" for r in some])
        gone = [_removed(r) for r in rows if _first(r) and r["before"] > 1.2 * r["noise"] and _foreseeable(r)]
        if gone:
            by_label["held-out error above noise removed, efforts and tremor aside"] = (
                f"median {100 * np.median(gone):.0f} %"
            )
        by_label |= _confusions(rows)
    elif kind == "nothing":
        by: dict[str, list[bool]] = defaultdict(list)
        for r in rows:
            by[json.dumps(r["options"])].append(r["verdict"] == "nothing_missing")
        by_label |= {f"nothing missing, {options}": share(flags) for options, flags in by.items()}
    elif kind == "outside":
        confident = [max(r["probabilities"], default=0.0) > SURE_PROBABILITY for r in rows]
        structure_left = [r["verdict"] == "unexplained_structure" for r in rows]
        by_label["verdict 'structure left'"] = share(structure_left)
        by_label["told: that, or structure said to be left and no effect for sure"] = share(
            [
                verdict or (r["structure said"] and not named)
                for r, verdict, named in zip(rows, structure_left, confident, strict=True)
            ]
        )
        by_label[f"an effect named above {SURE_PROBABILITY:g}"] = share(confident)
        for effect in sorted({r["effect"] for r in rows}):
            effect_rows = [r for r in rows if r["effect"] == effect]
            answers = Counter(r["named"][0] if r["verdict"] == "effect_missing" else r["verdict"] for r in effect_rows)
            by_label[f"  {effect}"] = ", ".join(f"{what} {count}" for what, count in answers.most_common())
    elif kind == "two":
        by_label["both named"] = share([set(r["truth"]) <= set(r["named"]) for r in rows])
        by_label["one named"] = share([bool(set(r["truth"]) & set(r["named"])) for r in rows])
        by_label |= {f"  {r['effect']} {r['seed']}": f"{', '.join(r['named'])} ({r['verdict']})" for r in rows}
    cpu = [r["cpu_seconds"] for r in rows]
    by_label["processor seconds a record"] = f"median {np.median(cpu):.1f}, largest {max(cpu):.1f}"
    return by_label


def _first(row: dict[str, Any]) -> bool:
    return row["named"][:1] == row["truth"][:1]


def _foreseeable(row: dict[str, Any]) -> bool:
    """Efforts and tremor can be seen and not foreseen: no model takes their error away from rows it has not seen."""
    effect = registry()[row["truth"][0]]
    return effect.predictable and not effect.band


def _removed(row: dict[str, Any]) -> float:
    excess = [np.sqrt(max(row[key] ** 2 - row["noise"] ** 2, 0.0)) for key in ("before", "after")]
    return 1.0 - excess[1] / max(excess[0], 1e-9)


def _confusions(rows: list[dict[str, Any]]) -> dict[str, str]:
    wrong = Counter((r["truth"][0], r["named"][0] if r["named"] else r["verdict"]) for r in rows if not _first(r))
    return {f"  {truth} named {named}": str(count) for (truth, named), count in wrong.most_common()}


def run(arguments: list[str] | None = None) -> None:
    """Diagnose the records of each set and print its figures."""
    parser = bench_parser(__doc__, "1003:1004")
    parser.add_argument("--only", default=",".join(SETS))
    parser.add_argument("--recorder", default="plain", help="with commas: joined, or as in bench.muscles.recorders")
    settings = parser.parse_args(arguments)
    everything = {}
    for kind in settings.only.split(","):
        run_jobs = [
            (effect, strength, seed, options | {"recorder": recorder})
            for effect, strength, seed, options in jobs(kind, settings.seeds)
            for recorder in settings.recorder.split(",")
        ]
        rows = [row for row in in_processes(diagnose_record, run_jobs) if row is not None]
        print(f"{kind}, seeds {settings.seeds.start} to {settings.seeds.stop - 1}, {len(rows)} records")
        if rows:
            print_figures(kind, rows)
        sys.stdout.flush()
        everything[kind] = rows
        write_json(settings.json, everything, None)


if __name__ == "__main__":
    run()
