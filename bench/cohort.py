"""Measure a cohort: throughput of one worker and of two, memory over the records, cost of a record, and a plan.

    python -m bench.cohort --records 10000 [--pairs 200] [--costs 12] [--json FILE]

`--records` short recordings (23 s at 100 samples/s) of simulated muscles are fitted by two workers: the memory of the
workers and of their computing processes over the records. `--pairs` of them are fitted, as many as the rig seals them
(48 s at 1600 samples/s) fitted, and a tenth as many short ones diagnosed, by one worker and by two, each after a
warm-up, twice in turn. `--costs` recordings as the rig
seals them are fitted and diagnosed by one worker: processor time and bytes of one, and from these the plan for two
million on paper.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq

from bench.common import bench_parser, table, write_json, written_by
from stimrig.api.cohort.cluster import connect
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.run import run_records
from stimrig.api.cohort.sources import list_records
from stimrig.api.cohort.task import Task
from stimrig.api.cohort.worker import RECORDS_PER_PROCESS, Bounds
from stimrig.api.version import software_version
from tests.harness.cohort_records import Session, write

MUSCLES = 100
"""Simulated; sessions of one differ by their noise."""
EFFECTS = (None, "fatigue", "threshold_drift", None, "asymmetric_relaxation")
PEOPLE = 40
SEALED = {"design": "full", "rate_hz": 1600.0}
"""As the rig seals them."""
PLANNED = 2_000_000
CORES = 100
PACES = {
    "one worker": "one_per_s",
    "two workers": "two_per_s",
}
MEMORY = {
    "process that computes, renewed after {renewed_after} records": "computing_mb",
    "worker of Dask": "worker_mb",
    "the run itself, with the scheduler": "client_mb",
}
COSTS = {
    "recordings measured": "records",
    "processor time, s, mean": "processor_s",
    "processor time, s, longest": "longest_processor_s",
    "time, s, mean": "took_s",
    "read, MB, mean": "read_mb",
    "memory of its process, MB, largest": "memory_mb",
}
ON_PAPER = {
    "processor time, h": "processor_h",
    f"time with {CORES} cores, h": "wall_h",
    "read, TB": "read_tb",
    "read by all together, MB/s": "read_mb_per_s",
}
MB = 1e6


def make(folder: Path, count: int, **more: Any) -> Path:
    """Recordings in subfolders of a thousand."""
    for number in range(count):
        muscle = number % MUSCLES
        place = folder / f"{number // 1000:04d}"
        place.mkdir(parents=True, exist_ok=True)
        effect = EFFECTS[muscle % len(EFFECTS)]
        session = Session(f"P{number % PEOPLE:03d}", seed=number, muscle=muscle, effect=effect, **more)
        write(place / f"{number:06d}.h5", session)
        if number and number % 1000 == 0:
            print(f"made {number} of {count}", file=sys.stderr, flush=True)
    return folder


class Watched(Results):
    """Results that sample the memory of the run's processes, MB, as rows come."""

    def __init__(self, *arguments: Any, every: int = 0) -> None:
        super().__init__(*arguments)
        self.every, self.rows, self.samples = every, 0, list[dict[str, float]]()

    def add(self, row: dict[str, Any]) -> str:
        """Add a row, and sample at some of them."""
        self.rows += 1
        if self.every and self.rows % self.every == 0:
            run = psutil.Process()
            workers = [child for child in run.children() if "spawn_main" in " ".join(child.cmdline())]
            sizes = [child.memory_info().rss / MB for child in workers]
            self.samples.append({"client_mb": run.memory_info().rss / MB, "worker_mb": max(sizes)})
        return super().add(row)


def run(
    folder: Path, output: Path, verb: str, workers: int, *, every: int = 0, warm: Path | None = None
) -> tuple[list[dict[str, Any]], float, list[dict[str, float]]]:
    """The rows of a run, its time without starting the workers, s, and samples of memory."""
    with connect(workers=workers) as client:
        if warm is not None:
            once(client, warm, output.with_name(f"warm-{output.name}"), verb)
        took_s, samples = once(client, folder, output, verb, every)
    return pq.read_table(output).to_pylist(), took_s, samples


def once(client: Any, folder: Path, output: Path, verb: str, every: int = 0) -> tuple[float, list[dict[str, float]]]:
    """One run over a folder with workers that are there; its time, s, and samples of memory."""
    task = Task(verb, software=software_version())
    with Watched(output, task, every=every) as results:
        began_s = time.perf_counter()
        run_records(client, list_records([str(folder)]), task, Bounds(), results)
        took_s = time.perf_counter() - began_s
        results.join()
    return took_s, results.samples


def throughput(folder: Path, place: Path, verb: str, count: int, **more: Any) -> dict[str, Any]:
    """Records a second with one worker and with two, in turn, so that other work on the machine meets both."""
    here = folder / f"pairs-{len(list(folder.iterdir()))}"
    records, warm = make(here / "records", count, **more), make(here / "warm", 8, **more)
    paces: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(2):
        for workers in (1, 2):
            output = place / f"{here.name}-{workers}-{turn}.parquet"
            paces[workers].append(count / run(records, output, verb, workers, warm=warm)[1])
    ratio = statistics.median(paces[2]) / statistics.median(paces[1])
    return {"records": count, "one_per_s": paces[1], "two_per_s": paces[2], "ratio": ratio}


def memory(folder: Path, place: Path, count: int) -> dict[str, Any]:
    """Memory over many records with two workers: of the first tenth and of the last."""
    records = make(folder / "many", count)
    rows, took_s, samples = run(records, place / "many.parquet", "fit", 2, every=max(1, count // 100))
    rows.sort(key=lambda row: row["computed_utc"])
    sizes = [row["worker_memory_mb"] for row in rows]
    tenth = max(1, count // 10)
    samples = samples[1:]
    return {
        "records": count,
        "ok": sum(row["status"] == "ok" for row in rows),
        "took_s": took_s,
        "records_per_s": count / took_s,
        "renewed_after": RECORDS_PER_PROCESS,
        "computing_mb": [statistics.fmean(sizes[:tenth]), statistics.fmean(sizes[-tenth:]), max(sizes)],
        "worker_mb": ends(samples, "worker_mb"),
        "client_mb": ends(samples, "client_mb"),
    }


def ends(samples: list[dict[str, float]], name: str) -> list[float]:
    """Mean of the first tenth, of the last tenth, and the largest."""
    values = [sample[name] for sample in samples] or [float("nan")]
    tenth = max(1, len(values) // 10)
    return [statistics.fmean(values[:tenth]), statistics.fmean(values[-tenth:]), max(values)]


def costs(folder: Path, place: Path, count: int) -> dict[str, Any]:
    """Processor time, time and bytes of a recording as the rig seals it, for fit and diagnose."""
    full = make(folder / "full", count, **SEALED)
    figures = {}
    for verb in ("fit", "diagnose"):
        rows = run(full, place / f"{verb}.parquet", verb, 1)[0]
        rows = [row for row in rows if row["status"] == "ok"]
        rows.sort(key=lambda row: row["computed_utc"])
        rows = rows[1:]  # the first one loads what was compiled
        figures[verb] = {
            "records": len(rows),
            "processor_s": statistics.fmean(row["processor_s"] for row in rows),
            "longest_processor_s": max(row["processor_s"] for row in rows),
            "took_s": statistics.fmean(row["took_s"] for row in rows),
            "read_mb": statistics.fmean(row["bytes"] for row in rows) / MB,
            "memory_mb": max(row["worker_memory_mb"] for row in rows),
        }
    return figures


def plan(cost: dict[str, Any]) -> dict[str, float]:
    """Two million recordings on paper."""
    hours = PLANNED * cost["processor_s"] / 3600
    read_tb = PLANNED * cost["read_mb"] * MB / 1e12
    return {"processor_h": hours, "wall_h": hours / CORES, "read_tb": read_tb,
            "read_mb_per_s": read_tb * 1e6 / (3600 * hours / CORES)}  # fmt: skip


def report(figures: dict[str, Any]) -> list[str]:
    """The figures as a page."""
    pace, mem, cost = figures["throughput"], figures["memory"], figures["costs"]
    load = ", ".join(f"{value:.1f}" for value in figures["load"])
    return [
        f"{figures['processors']} processors, load average {load} at the start and "
        f"{', '.join(f'{value:.1f}' for value in figures['load_after'])} at the end.",
        "",
        *table(
            ["throughput, records a second, two runs each", *pace],
            [
                *([words, *(both(case[name]) for case in pace.values())] for words, name in PACES.items()),
                ["ratio (goal 1.8)", *(format(case["ratio"], ".2f") for case in pace.values())],
                ["recordings a run", *(case["records"] for case in pace.values())],
            ],
        ),
        "",
        *table(
            [f"memory over {mem['records']} records, 2 workers, MB", "first tenth", "last tenth", "largest"],
            ([words.format(**mem), *(f"{mb:.0f}" for mb in mem[name])] for words, name in MEMORY.items()),
        ),
        "",
        f"{mem['ok']} of {mem['records']} with a result, {mem['records_per_s']:.1f} a second.",
        "",
        *of_verbs("cost of a recording (48 s at 1600 samples/s)", cost, COSTS),
        "",
        *of_verbs(f"{PLANNED:,}".replace(",", " ") + " such recordings, on paper", figures["plan"], ON_PAPER),
    ]


def of_verbs(title: str, figures: dict[str, Any], rows: dict[str, str]) -> list[str]:
    """Figures of both verbs."""
    verbs = ("fit", "diagnose")
    cells = ([words, *(f"{figures[verb][name]:.3g}" for verb in verbs)] for words, name in rows.items())
    return table([title, *verbs], cells)


def both(values: list[float]) -> str:
    """Paces of two runs."""
    return ", ".join(f"{value:.3g}" for value in values)


def main() -> None:
    """Print the page."""
    parser = bench_parser(__doc__)
    parser.add_argument("--records", type=int, default=10_000, help="of the run over which memory is looked at")
    parser.add_argument("--pairs", type=int, default=200, help="of each run that compares one worker with two")
    parser.add_argument("--costs", type=int, default=12, help="recordings as sealed, fitted and diagnosed")
    parser.add_argument("--json", type=Path, help="write the figures here, too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stimrig-bench-cohort-") as scratch:
        folder, place = Path(scratch) / "records", Path(scratch) / "results"
        place.mkdir()
        figures: dict[str, Any] = {"load": os.getloadavg(), "processors": os.cpu_count()}
        figures["costs"] = costs(folder, place, options.costs)
        figures["throughput"] = {
            "fit, as sealed": throughput(folder, place, "fit", options.pairs, **SEALED),
            "fit, short": throughput(folder, place, "fit", options.pairs),
            "diagnose, short": throughput(folder, place, "diagnose", max(4, options.pairs // 10)),
        }
        figures["memory"] = memory(folder, place, options.records)
    figures["plan"] = {verb: plan(cost) for verb, cost in figures["costs"].items()}
    figures["load_after"] = os.getloadavg()
    command = f"python -m bench.cohort --records {options.records} --pairs {options.pairs} --costs {options.costs}"
    print(written_by(command), "", *report(figures), sep="\n")
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
