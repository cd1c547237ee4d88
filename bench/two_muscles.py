"""Two muscles identified in one test: what it costs, how well it predicts, and whether their interplay is named.

    python -m bench.two_muscles --seeds 1000:1040 [--noise 0.05] [--cross-talk X] [--json FILE]

Emulated joints by seed. One test of both (`rig.protocols.several`) beside the paper's test of each
muscle by itself; both are judged on an unseen record in which both muscles move at once, without its noise. Seeds 0 to
99 are for development.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.common import in_processes, keep, parser, table
from stimrig import identify
from stimrig.hardware_sim.joint_records import draw_joint
from stimrig.hardware_sim.joint_records import record as make
from stimrig.identify import muscles
from stimrig.identify.muscles.finish import finished
from stimrig.identify.muscles.search import search
from stimrig.rig import protocols, sequences
from stimrig.rig.messages import SegmentPlan

NAMES = ("biceps", "triceps")
RATE_HZ, PULSES_HZ = 400.0, 40.0
NAMED_FROM = 0.1
"""Cross-talk from which it must be named."""


@dataclass(frozen=True)
class Job:
    """One joint at one noise."""

    seed: int
    noise_nm: float
    cross_talk: float | None
    co_contraction: float | None
    plain: bool


def widths(segments: Sequence[SegmentPlan], largest_us: Sequence[float]) -> tuple[np.ndarray, list[str]]:
    """Widths of both channels, shape (2, P), and each pulse's segment; without `channels` the first one plays."""
    columns: list[np.ndarray] = []
    names: list[str] = []
    for segment in segments:
        given = segment.channels or {}
        parts = [given.get(name) for name in NAMES]
        own = [segment if part is None and not place else part for place, part in enumerate(parts)]
        built = [np.zeros(0) if one is None else _built(one, top) for one, top in zip(own, largest_us, strict=True)]
        size = max(len(one) for one in built)
        columns.append(np.stack([np.pad(one, (0, size - len(one))) for one in built]))
        names += [segment.name] * size
    return np.concatenate(columns, axis=1), names


def _built(part: Any, top_us: float) -> np.ndarray:
    known = sequences.find(part.sequence).Settings.model_fields
    own = {"max_pulse_width_us": top_us} if "max_pulse_width_us" in known else {}
    return sequences.build(part.sequence, own | dict(part.settings), PULSES_HZ)


def unseen_widths(seed: int, largest_us: Sequence[float]) -> np.ndarray:
    """Ten seconds in which both move, in no test."""
    rests = np.zeros((2, 80))
    settings = [{"duration_s": 10.0, "seed": 9000 + 2 * seed + place} for place in (0, 1)]
    rows = [
        sequences.build("multilevel", one | {"max_pulse_width_us": top}, PULSES_HZ)
        for one, top in zip(settings, largest_us, strict=True)
    ]
    return np.concatenate([rests, np.stack(rows)], axis=1)


def as_record(made: dict[str, Any], names: Sequence[str] | None = None) -> muscles.JointRecord:
    """What was made, as it is read."""
    segment = None if names is None else list(np.repeat(names, round(RATE_HZ / PULSES_HZ)))
    channels = [muscles.Channel(NAMES[0]), muscles.Channel(NAMES[1], offset_s=0.5 / PULSES_HZ)]
    own = {NAMES[0]: made["first_us"], NAMES[1]: made["second_us"]}
    return muscles.JointRecord.from_arrays(channels, made["time_s"], own, made["torque_nm"], segment)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def run_job(job: Job) -> dict[str, Any]:
    """One joint, tested both ways."""
    joint = draw_joint(job.seed, job.cross_talk, job.co_contraction, job.plain)
    top = [float(muscle.base.largest_width_us) for muscle in (joint.agonist, joint.antagonist)]
    both_us, names = widths(protocols.several(NAMES), top)
    made = make(joint, *both_us, noise_sd_nm=job.noise_nm, seed=1)
    record = as_record(made, names)
    begun_s = time.perf_counter()
    found = search(record)
    took_s = time.perf_counter() - begun_s
    model = finished(found.last)
    unseen = make(joint, *unseen_widths(job.seed, top), noise_sd_nm=0.0, seed=2)
    error = muscles.predict(model, as_record(unseen)) - unseen["clean_nm"]
    plain = finished(found.chain[0])
    plain_error = muscles.predict(plain, as_record(unseen)) - unseen["clean_nm"]
    separate, paper_us = _separately(joint, top, job, unseen)
    truth = made["truth"]
    return {
        "seed": job.seed,
        "noise_nm": job.noise_nm,
        "truth": truth,
        "added": [one.key for one in found.added],
        "unexplained": found.unexplained,
        "error": rms(error),
        "plain_error": rms(plain_error),
        "separate_error": separate,
        "noise": job.noise_nm,
        "duration": both_us.shape[1] / paper_us.shape[1],
        "dose": (both_us.sum(axis=1) / paper_us.sum(axis=1)).tolist(),
        "took_s": took_s,
    }


def _separately(joint: Any, top: Sequence[float], job: Job, unseen: dict[str, Any]) -> tuple[float, np.ndarray]:
    """The error of two models, each from the paper's test of its muscle by itself; and those tests' widths."""
    plan = protocols.segments("paper", max(top))
    predicted, played = np.zeros(unseen["clean_nm"].size), []
    for place in (0, 1):
        own_us, names = widths(plan, [top[place]] * 2)
        rows = np.zeros_like(own_us)
        rows[place] = own_us[0]
        played.append(own_us[0])
        made = make(joint, *rows, noise_sd_nm=job.noise_nm, seed=10 + place)
        column = "second_us" if place else "first_us"
        segment = list(np.repeat(names, round(RATE_HZ / PULSES_HZ)))
        record = identify.Record.from_arrays(made["time_s"], made[column], made["torque_nm"], segment)
        model = identify.improve(record).models[-1]
        ahead = identify.Record.from_arrays(unseen["time_s"], unseen[column], unseen["torque_nm"])
        predicted += identify.predict(model, ahead) - model.baseline_nm
    return rms(predicted - unseen["clean_nm"]), np.stack(played)


def summary(rows: Sequence[dict[str, Any]]) -> list[list[str]]:
    """The goals, and what was reached."""
    error, separate = (np.array([row[key] for row in rows]) for key in ("error", "separate_error"))
    noise = np.array([row["noise"] for row in rows])
    expected = [(row, end) for row in rows for end in (0, 1)]
    strong = [(row, end) for row, end in expected if _cross(row, end) >= NAMED_FROM]
    none = [(row, end) for row, end in expected if _cross(row, end) == 0.0]
    named = sum(_key(end) in row["added"] for row, end in strong)
    wrong = sum(_key(end) in row["added"] for row, end in none)
    return [
        ["duration over one muscle's test", f"{max(row['duration'] for row in rows):.2f}", "<= 1.5"],
        ["dose of each over its own test", f"{max(max(row['dose']) for row in rows):.2f}", "<= 1.3"],
        ["unseen error over that of two tests, median", f"{np.median(error / separate):.2f}", "<= 1.05"],
        ["the same, worse than 1.05", f"{np.mean(error > 1.05 * separate):.0%}", ""],
        ["unseen error over noise, median", f"{np.median(error / noise):.2f}", "<= 1.3"],
        ["the same, within 1.3", f"{np.mean(error <= 1.3 * noise):.0%}", ""],
        [f"cross-talk of {NAMED_FROM:.0%} and more named", f"{named} of {len(strong)}", ">= 90 %"],
        ["cross-talk named where there is none", f"{wrong} of {len(none)}", "<= 2 %"],
        ["time of the search, median", f"{np.median([row['took_s'] for row in rows]):.0f} s", ""],
    ]


def _cross(row: dict[str, Any], end: int) -> float:
    return float(row["truth"]["cross_talk"][end])


def _key(end: int) -> str:
    return f"cross_talk:{NAMES[end]}>{NAMES[1 - end]}"


def main() -> None:
    options = parser(__doc__, "1000:1040")
    options.add_argument("--noise", type=float, nargs="+", default=[0.02, 0.05, 0.1])
    options.add_argument("--cross-talk", type=float)
    options.add_argument("--co-contraction", type=float)
    options.add_argument("--plain", action="store_true", help="neither fatigue nor speed that depends on activation")
    options.add_argument("--workers", type=int, default=2)
    given = options.parse_args()
    jobs = [
        Job(seed, given.noise[number % len(given.noise)], given.cross_talk, given.co_contraction, given.plain)
        for number, seed in enumerate(given.seeds)
    ]
    rows = []
    for row in in_processes(run_job, jobs, given.workers):
        rows.append(row)
        shown = {key: row["truth"][key] for key in ("cross_talk", "co_contraction")}
        print(
            f"{row['seed']} noise {row['noise']} truth {shown} added {row['added']} {row['unexplained']} error "
            f"{row['error']:.4f} plain {row['plain_error']:.4f} separate {row['separate_error']:.4f}",
            flush=True,
        )
    keep(given.json, rows)
    print("\n".join(table(("what", "reached", "goal"), summary(rows))))


if __name__ == "__main__":
    main()
