"""An adaptive test against fixed tests, on the same simulated patients.

    python -m bench.adaptive --patients 40 --seeds 80000 [--kinds sigmoid,shaped] [--json FILE]

Each patient has noise of 0.05 N·m at 400 Hz, the same in every test. Seeds from 50000 were developed on. Tests: the
paper's (PRBS and ramp with their rests, 29.7 s, without the held-out levels of the default test), the protocol `short`
without its held-out levels, ours for a new person, and ours for a person who is known from one earlier session. A test
whose structure fits badly goes on with the paper's test; its dose and time count. "Unseen" is the best fit to the clean
torque of random levels.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import bench_parser, table, write_json_lines
from stimrig import identify
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.experiments.adaptive import Target
from stimrig.identify.experiments.knowledge import Knowledge
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.rig import protocols
from stimrig.rig.sequences import build
from tests.harness.adaptive import Muscle, Played, play, recorded, shaped, sigmoid

RATE_HZ, NOISE_NM = 400.0, 0.05
TARGET = Target()
LONGEST_S = 60.0
KINDS: dict[str, Callable[[int], Muscle]] = {"sigmoid": sigmoid, "shaped": shaped}


def paper_test(top_us: float, protocol: str = "paper", held_out: bool = False) -> tuple[np.ndarray, list[str]]:
    """Widths and names of a protocol: of the paper's, PRBS and ramp with their rests, and the held-out levels."""
    widths, names = [], []
    for segment in protocols.segments(protocol, top_us):
        if segment.name == "validate" and not held_out:
            break
        settings = dict(segment.settings)
        if segment.sequence != "rest":
            settings.setdefault("max_pulse_width_us", top_us)
        segment_us = build(segment.sequence, settings, 40.0)
        widths.append(segment_us)
        names += [segment.name] * segment_us.size
    return np.concatenate(widths), names


def unseen_percent(muscle: Any, predict: Callable[[Record], np.ndarray], seed: int) -> float:
    """Best fit to the clean torque of random levels, %."""
    levels = np.random.default_rng([seed, 7]).uniform(0.0, muscle.top_us, 30)
    widths = np.r_[np.zeros(40), np.repeat(levels, 20)]
    record = recorded(muscle, widths, ["validate"] * widths.size, np.zeros(20000), RATE_HZ)
    return best_fit_percent(record.torque_nm, predict(record))


def row(muscle: Any, widths: np.ndarray, covered: tuple[bool, bool], unseen: float, **more: Any) -> dict[str, Any]:
    """One line of the results."""
    dose = float(np.sum(muscle.curve(widths))) / 40.0
    return {
        "seconds": widths.size / 40.0,
        "dose": dose,
        "curve_covered": covered[0],
        "step_covered": covered[1],
        "unseen": unseen,
    } | more


def covered_by(known: Knowledge, muscle: Any) -> tuple[bool, bool]:
    """Return for each of the two true curves whether the bands contain it."""
    curve_error = np.abs(muscle.curve(known.curve.at) / known.plateau_nm - known.curve.value)
    step_error = np.abs(muscle.step(known.step.at) - known.step.value)
    return bool(np.all(curve_error <= known.curve.half)), bool(np.all(step_error <= known.step.half))


def covered_by_model(model: Model, muscle: Any) -> tuple[bool, bool]:
    """Return the same for the simultaneous bands of a model."""
    curve, step = model.bands["recruitment"], model.bands["step_response"]
    true = muscle.curve(np.asarray(curve["pulse_width_us"]))
    slack = 1e-6 * float(np.max(true))
    first = np.all((curve["whole_lower"] - slack <= true) & (true <= curve["whole_upper"] + slack))
    true_step = muscle.step(np.asarray(step["time_s"]))
    second = np.all((step["whole_lower"] - 1e-6 <= true_step) & (true_step <= step["whole_upper"] + 1e-6))
    return bool(first), bool(second)


def fixed(muscle: Muscle, test: tuple[np.ndarray, list[str]], noise: np.ndarray, seed: int) -> dict[str, Any]:
    """A fixed test with the default fit."""
    model = identify.fit(recorded(muscle, *test, noise, RATE_HZ))
    return row(muscle, test[0], covered_by_model(model, muscle), unseen_percent(muscle, model.predict, seed))


def adaptive(
    muscle: Muscle, noise: np.ndarray, seed: int, earlier: Model | None = None
) -> tuple[dict[str, Any], Model]:
    """Our test, with the model that it leaves."""
    spent: list[float] = []

    def timed(call: Callable[[], Any]) -> Any:
        began = time.process_time()
        result = call()
        spent.append(time.process_time() - began)
        return result

    known = {} if earlier is None else {"earlier": Earlier(earlier)}
    limits = {"left_s": LONGEST_S / 2.0, "left_nm_s": float(np.sum(muscle.curve(paper_test(muscle.top_us)[0]))) / 40.0}
    played = play(muscle, noise, TARGET, timed=timed, **limits, **known)
    result, model = finished(muscle, played, noise, seed, {} if earlier is None else {"earlier": earlier})
    return result | {"cpu_s": [round(s, 4) for s in spent[2:]]}, model


def finished(
    muscle: Any, played: Played, noise: np.ndarray, seed: int, known: dict[str, Model]
) -> tuple[dict[str, Any], Model]:
    """The row and the model of a test that ended; where the structure fits badly, the paper's test comes after it."""
    assert played.record is not None
    if played.decision.kind == "misfit":
        widths, names = paper_test(muscle.top_us)
        widths = np.r_[played.widths_us, widths]
        model = identify.fit(recorded(muscle, widths, played.names + names, noise, RATE_HZ))
        covered = covered_by_model(model, muscle)
    else:
        widths = played.widths_us
        model = identify.fit(played.record, recruitment="near-sigmoid", **known)
        assert played.decision.knowledge is not None
        covered = covered_by(played.decision.knowledge, muscle)
    unseen = unseen_percent(muscle, model.predict, seed)
    return row(muscle, widths, covered, unseen, ended=played.decision.kind), model


def compare_tests(kind: str, seed: int, wanted: str) -> list[dict[str, Any]]:
    """Play the wanted peers on one patient."""
    muscle = KINDS[kind](seed)
    noise = np.random.default_rng([seed, 5]).standard_normal(int((LONGEST_S + 30.0) * RATE_HZ)) * NOISE_NM
    other = np.random.default_rng([seed, 6]).standard_normal(noise.size) * NOISE_NM
    day = muscle.another_day(np.random.default_rng([seed, 8]))
    peers: dict[str, Callable[[], dict[str, Any]]] = {
        "paper": lambda: fixed(muscle, paper_test(muscle.top_us), noise, seed),
        "short": lambda: fixed(muscle, paper_test(muscle.top_us, "short"), noise, seed),
        "ours, new": lambda: adaptive(muscle, noise, seed)[0],
        "ours, known": lambda: adaptive(muscle, noise, seed, earlier=adaptive(day, other, seed)[1])[0],
    }
    peer_rows = {peer: play_peer() for peer, play_peer in peers.items() if peer in wanted or peer == "paper"}
    paper = peer_rows["paper"]
    return [
        line
        | {"peer": peer, "kind": kind, "shape": muscle.name, "seed": seed}
        | {"dose_share": line["dose"] / paper["dose"], "time_share": line["seconds"] / paper["seconds"]}
        | {"unseen_gain": line["unseen"] - paper["unseen"]}
        for peer, line in peer_rows.items()
    ]


def medians(rows: list[dict[str, Any]]) -> list[str]:
    """Medians and counts as lines of a table."""
    heads = "patients; test; n; unseen, %; against the paper's test, points; dose, N·m·s; dose; time, s; time"
    cells = []
    for kind in dict.fromkeys(line["kind"] for line in rows):
        for peer in dict.fromkeys(line["peer"] for line in rows):
            peer_rows = [line for line in rows if line["kind"] == kind and line["peer"] == peer]
            if not peer_rows:
                continue
            numbers = [key for key, value in peer_rows[0].items() if _number(value)]
            mid = {key: float(np.median([line[key] for line in peer_rows])) for key in numbers}
            curve, step = (sum(line[key] for line in peer_rows) for key in ("curve_covered", "step_covered"))
            fit = [f"{mid['unseen']:.2f}", f"{mid['unseen_gain']:+.2f}"]
            took = [f"{mid['dose']:.1f}", f"{100 * mid['dose_share']:.0f} %"]
            took += [f"{mid['seconds']:.1f}", f"{100 * mid['time_share']:.0f} %"]
            covered = [f"{count} ({100 * count / len(peer_rows):.0f} %)" for count in (curve, step)]
            cells.append([kind, peer, len(peer_rows), *fit, *took, *covered])
    lines = table([*heads.split("; "), "f covered", "step covered"], cells)
    ended = [line["ended"] for line in rows if line["peer"] == "ours, new"]
    lines.append(f"\nOurs, new, ended: {', '.join(f'{e} {ended.count(e)}' for e in dict.fromkeys(ended))}.")
    cpu = np.array([s for line in rows if line["peer"].startswith("ours") for s in line.get("cpu_s", [])])
    if cpu.size:
        median_s, p99_s = np.quantile(cpu, [0.5, 0.99])
        lines.append(f"`decide`: {1e3 * median_s:.0f} ms of processor time in the middle, p99 {1e3 * p99_s:.0f} ms.")
    return lines


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def main() -> None:
    """Print the tables."""
    parser = bench_parser(__doc__)
    parser.add_argument("--patients", type=int, default=150, help="of each kind")
    parser.add_argument("--seeds", type=int, default=80_000, help="the first")
    parser.add_argument("--kinds", default="sigmoid,shaped")
    parser.add_argument("--peers", default="paper; short; ours, new; ours, known")
    parser.add_argument("--json", type=Path, help="every row goes here, one a line")
    settings = parser.parse_args()
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    rows: list[dict[str, Any]] = []
    for seed in range(settings.seeds, settings.seeds + settings.patients):
        for kind in settings.kinds.split(","):
            rows += compare_tests(kind, seed, settings.peers)
            print(seed, kind, file=sys.stderr, flush=True)
        write_json_lines(settings.json, rows)
    print(*(medians(rows) if rows else []), sep="\n")


if __name__ == "__main__":
    main()
