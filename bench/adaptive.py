"""An adaptive test against fixed tests and other choosers, on the same simulated patients.

    python -m bench.adaptive --patients 40 --seeds 80000 [--kinds sigmoid,shaped] [--hidden 20] [--json FILE]

Each patient has noise of 0.05 N·m at 400 Hz, and every peer sees the same noise. Seeds from 50000 were developed on.
Peers: the paper's test (PRBS and ramp with their rests, 29.7 s, without the held-out levels of the default test), the
protocol `short` without its held-out levels, a staircase, pieces of our library taken at random, a chooser as
`optbayesexpt` (`bench.particles`), ours for a new person, and ours for a person who is known from one earlier session.
A test whose structure fits badly goes on with the paper's test; its dose and time count. "Unseen" is the best fit to
the clean torque of random levels.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import keep_lines, lines_of, parser, table
from bench.particles import HOLD, Particles
from stimrig import identify
from stimrig.hardware_sim.hidden.library import STILL
from stimrig.hardware_sim.hidden.scenario import draw_scenario, rng_of
from stimrig.identify.diagnosis import diagnose
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.estimation.earlier import Earlier
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.experiments.adaptive import Target
from stimrig.identify.experiments.designs import pieces
from stimrig.identify.experiments.knowledge import Knowledge, step_responses, whole_band
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.rig import protocols
from stimrig.rig.sequences import build
from tests.harness.adaptive import Hidden, Muscle, Played, papers, play, recorded, shaped, sigmoid

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
        own = build(segment.sequence, settings, 40.0)
        widths.append(own)
        names += [segment.name] * own.size
    return np.concatenate(widths), names


def staircase(top_us: float) -> tuple[np.ndarray, list[str]]:
    """One second of rest and six levels up and down, one second each."""
    up = np.arange(1, 7) / 6.0
    widths = np.repeat(np.r_[0.0, up, up[-2::-1], 0.0] * top_us, 40)
    return widths, ["staircase"] * widths.size


def unseen_percent(muscle: Any, predict: Callable[[Record], np.ndarray], seed: int) -> float:
    """Best fit to the clean torque of random levels, %."""
    levels = np.random.default_rng([seed, 7]).uniform(0.0, muscle.top_us, 30)
    widths = np.r_[np.zeros(40), np.repeat(levels, 20)]
    record = recorded(muscle, widths, ["validate"] * widths.size, np.zeros(20000), RATE_HZ)
    return best_fit_percent(record.torque_nm, predict(record))


def row(
    muscle: Any, widths: np.ndarray, covered: tuple[bool, bool, float], unseen: float, **more: Any
) -> dict[str, Any]:
    """One line of the results."""
    dose = float(np.sum(muscle.curve(widths))) / 40.0
    curve, step, band = covered
    return {
        "seconds": widths.size / 40.0,
        "dose": dose,
        "curve_covered": curve,
        "step_covered": step,
        "band_percent": band,
        "unseen": unseen,
    } | more


def covered_by(known: Knowledge, muscle: Any) -> tuple[bool, bool, float]:
    """Whether the bands contain both true curves, and the largest half-width of f's, %."""
    away = np.abs(muscle.curve(known.curve.at) / known.plateau_nm - known.curve.value)
    beside = np.abs(muscle.step(known.step.at) - known.step.value)
    return bool(np.all(away <= known.curve.half)), bool(np.all(beside <= known.step.half)), known.curve.percent


def covered_by_model(model: Model, muscle: Any) -> tuple[bool, bool, float]:
    """The same of a model's own whole bands."""
    curve, step = model.bands["recruitment"], model.bands["step_response"]
    true = muscle.curve(np.asarray(curve["pulse_width_us"]))
    slack = 1e-6 * float(np.max(true))
    first = np.all((curve["whole_lower"] - slack <= true) & (true <= curve["whole_upper"] + slack))
    true_step = muscle.step(np.asarray(step["time_s"]))
    second = np.all((step["whole_lower"] - 1e-6 <= true_step) & (true_step <= step["whole_upper"] + 1e-6))
    half = np.max(np.asarray(curve["whole_upper"]) - curve["value"])
    return bool(first), bool(second), 100.0 * float(half / np.max(true))


def fixed(muscle: Muscle, test: tuple[np.ndarray, list[str]], noise: np.ndarray, seed: int) -> dict[str, Any]:
    """A fixed test with the default fit."""
    model = identify.fit(recorded(muscle, *test, noise, RATE_HZ))
    return row(muscle, test[0], covered_by_model(model, muscle), unseen_percent(muscle, model.predict, seed))


def adaptive(
    muscle: Muscle, noise: np.ndarray, seed: int, earlier: Model | None = None, random: bool = False
) -> tuple[dict[str, Any], Model]:
    """Our test, or its pieces at random; with the model that it leaves."""
    spent: list[float] = []

    def timed(call: Callable[[], Any]) -> Any:
        began = time.process_time()
        found = call()
        spent.append(time.process_time() - began)
        return found

    rng = np.random.default_rng([seed, 9])

    def by_chance(_decision: Any, _widths: np.ndarray) -> np.ndarray:
        levels = np.r_[0.0, rng.uniform(0.0, muscle.top_us, 4), muscle.top_us]
        own = pieces(levels, 40.0)
        return own[int(rng.integers(len(own)))].pulse_width_us

    known = {} if earlier is None else {"earlier": Earlier(earlier)}
    limits = {"left_s": LONGEST_S / 2.0, "left_nm_s": float(np.sum(muscle.curve(paper_test(muscle.top_us)[0]))) / 40.0}
    made = play(muscle, noise, TARGET, timed=timed, choose=by_chance if random else None, **limits, **known)
    result, model = finished(muscle, made, noise, seed, {} if earlier is None else {"earlier": earlier})
    return result | {"cpu_s": [round(s, 4) for s in spent[2:]]}, model


def finished(
    muscle: Any, made: Played, noise: np.ndarray, seed: int, known: dict[str, Model]
) -> tuple[dict[str, Any], Model]:
    """The row and the model of a test that ended; where the structure fits badly, the paper's test comes after it."""
    assert made.record is not None
    if made.decision.kind == "misfit":
        widths, names = paper_test(muscle.top_us)
        widths = np.r_[made.widths_us, widths]
        model = identify.fit(recorded(muscle, widths, made.names + names, noise, RATE_HZ))
        covered = covered_by_model(model, muscle)
    else:
        widths = made.widths_us
        model = identify.fit(made.record, recruitment="near-sigmoid", **known)
        assert made.decision.knowledge is not None
        covered = covered_by(made.decision.knowledge, muscle)
    unseen = unseen_percent(muscle, model.predict, seed)
    return row(muscle, widths, covered, unseen, ended=made.decision.kind), model


def chosen_by_particles(muscle: Muscle, noise: np.ndarray, seed: int) -> dict[str, Any]:
    """The stand-in for `optbayesexpt`: it stops at the same target, or with the time of the paper's test."""
    widths = np.r_[np.zeros(20), np.full(HOLD, muscle.top_us)]
    cloud, known, size = None, None, 0
    while widths.size < paper_test(muscle.top_us)[0].size:
        record = recorded(muscle, widths, ["level"] * widths.size, noise, RATE_HZ)
        torque = prepare(record)[0].torque_nm
        if cloud is None:
            cloud = Particles(muscle.top_us, float(np.max(torque)), NOISE_NM / np.sqrt(10.0), seed)
        cloud.learn(widths, torque, widths.size - size)
        size = widths.size
        known = particle_bands(cloud.drawn(), muscle.top_us)
        if known.curve.percent <= TARGET.curve_percent and known.step.percent <= TARGET.step_percent:
            break
        widths = np.r_[widths, np.full(HOLD, cloud.next_level(widths))]
    assert cloud is not None and known is not None
    gain, width, middle, slow, damping, delay = cloud.drawn().mean(axis=0)
    share = 1.0 / (1.0 + np.exp(-(np.arange(512.0) - middle) / np.exp(width)))
    model = Muscle(
        "", gain * (share - share[0]), muscle.top_us, float(np.exp(slow)), float(np.exp(damping)), max(delay, 0.0)
    )

    def predicted(record: Record) -> np.ndarray:
        return model.torque(record.pulse_width_us[:: round(RATE_HZ / 40.0)], RATE_HZ)

    return row(muscle, widths, covered_by(known, muscle), unseen_percent(muscle, predicted, seed))


def particle_bands(rows: np.ndarray, top_us: float) -> Knowledge:
    """Bands of a cloud."""
    u = np.linspace(0.0, top_us, 61)
    share = 1.0 / (1.0 + np.exp(-(u[None, :] - rows[:, 2:3]) / np.exp(rows[:, 1:2])))
    curves = rows[:, :1] * (share - share[:, :1])
    plateau = float(curves[:, -1].mean())
    time_s = np.linspace(0.0, 3.0, 61)
    steps = step_responses(np.c_[np.exp(rows[:, 3:5]), rows[:, 5]], time_s)
    return Knowledge(whole_band(u, curves / plateau), whole_band(time_s, steps), plateau)


def one(kind: str, seed: int, wanted: str) -> list[dict[str, Any]]:
    """The wanted peers on one patient."""
    muscle = KINDS[kind](seed)
    noise = np.random.default_rng([seed, 5]).standard_normal(int((LONGEST_S + 30.0) * RATE_HZ)) * NOISE_NM
    other = np.random.default_rng([seed, 6]).standard_normal(noise.size) * NOISE_NM
    day = muscle.another_day(np.random.default_rng([seed, 8]))
    peers: dict[str, Callable[[], dict[str, Any]]] = {
        "paper": lambda: fixed(muscle, paper_test(muscle.top_us), noise, seed),
        "short": lambda: fixed(muscle, paper_test(muscle.top_us, "short"), noise, seed),
        "staircase": lambda: fixed(muscle, staircase(muscle.top_us), noise, seed),
        "random pieces": lambda: adaptive(muscle, noise, seed, random=True)[0],
        "particles": lambda: chosen_by_particles(muscle, noise, seed),
        "ours, new": lambda: adaptive(muscle, noise, seed)[0],
        "ours, known": lambda: adaptive(muscle, noise, seed, earlier=adaptive(day, other, seed)[1])[0],
    }
    found = {peer: play_peer() for peer, play_peer in peers.items() if peer in wanted or peer == "paper"}
    paper = found["paper"]
    return [
        line
        | {"peer": peer, "kind": kind, "shape": muscle.name, "seed": seed}
        | {"dose_share": line["dose"] / paper["dose"], "time_share": line["seconds"] / paper["seconds"]}
        | {"unseen_gain": line["unseen"] - paper["unseen"]}
        for peer, line in found.items()
    ]


def hidden_muscle(seed: int) -> tuple[str, str, Hidden]:
    """Name and strength of one hidden effect, and the muscle."""
    for attempt in range(20):
        rng = rng_of(seed, "adaptive", str(attempt))
        effect, strength = str(rng.choice(STILL)), str(rng.choice(["weak", "middle", "strong"]))
        try:
            return effect, strength, Hidden(draw_scenario((effect,), strength, seed + attempt, noise_sd_nm=NOISE_NM))
        except ValueError:
            continue
    raise ValueError(f"seed {seed}: no muscle found")


def hidden(seed: int) -> dict[str, Any]:
    """What the diagnosis names of one hidden effect: after our test, the paper's test, and the paper's test twice."""
    workers.WORKERS = 1
    effect, strength, muscle = hidden_muscle(seed)
    noise = np.random.default_rng([seed, 5]).standard_normal(int(3 * LONGEST_S * RATE_HZ)) * NOISE_NM
    paper = paper_test(muscle.top_us, held_out=True)
    dose = float(np.sum(muscle.curve(paper[0]))) / 40.0
    made = play(muscle, noise, TARGET, left_s=LONGEST_S / 2.0, left_nm_s=dose)
    own = made.widths_us, made.names
    if made.decision.kind == "misfit":
        own = np.r_[own[0], paper[0]], own[1] + paper[1]
    tests = {"ours": own, "paper": paper, "paper twice": (np.tile(paper[0], 2), paper[1] * 2)}
    line: dict[str, Any] = {"seed": seed, "effect": effect, "strength": strength, "ended": made.decision.kind}
    for name, test in tests.items():
        found = diagnose(recorded(muscle, *test, noise, RATE_HZ))
        line[name] = {
            "verdict": found.verdict,
            "named": [entry["effect"] for entry in found.missing],
            "group": found.missing[0]["confused_with"] if found.missing else [],
            "dose_share": round(float(np.sum(muscle.curve(test[0]))) / 40.0 / dose, 3),
        }
    return line


def told_of_hidden(rows: list[dict[str, Any]]) -> list[str]:
    """How often each test let the diagnosis name the effect."""
    lines = []
    for test in ("ours", "paper", "paper twice"):
        first = sum(line[test]["named"][:1] == [line["effect"]] for line in rows)
        others = sum(bool(line[test]["named"]) and line["effect"] not in line[test]["named"] for line in rows)
        nothing = sum(not line[test]["named"] for line in rows)
        share = float(np.median([line[test]["dose_share"] for line in rows]))
        lines.append([test, len(rows), first, others, nothing, f"{100 * share:.0f} %"])
    heads = "test; n; named first; only others named; nothing named; dose, of the paper's, median"
    return table(heads.split("; "), lines)


def of_papers_muscle(trials: int, seed: int) -> list[str]:
    """The paper's muscle at 40 Hz with noise of 0.10 N·m and a target of 7 %: six times the noise of an interval."""
    lines = []
    for trial in range(seed, seed + trials):
        muscle, rng = papers(), np.random.default_rng([trial, 5])
        noise = rng.standard_normal(4000) * 0.10
        limits = {"left_s": 30.0, "left_nm_s": 83.0}
        made = play(muscle, noise, Target(7.0, 7.0), rate_hz=40.0, **limits)
        assert made.record is not None
        model = identify.fit(made.record, recruitment="near-sigmoid")
        fit = unseen_percent(muscle, model.predict, trial)
        lines.append(f"{made.decision.kind} {fit:.2f} % at {made.dose_nm_s(muscle):.1f} N·m·s in {made.seconds:.1f} s")
    return lines


def medians(rows: list[dict[str, Any]]) -> list[str]:
    """Medians and counts as lines of a table."""
    heads = "patients; test; n; unseen, %; against the paper's test, points; dose, N·m·s; dose; time, s; time"
    cells = []
    for kind in dict.fromkeys(line["kind"] for line in rows):
        for peer in dict.fromkeys(line["peer"] for line in rows):
            own = [line for line in rows if line["kind"] == kind and line["peer"] == peer]
            if not own:
                continue
            mid = {key: float(np.median([line[key] for line in own])) for key in own[0] if _number(own[0][key])}
            curve, step = (sum(line[key] for line in own) for key in ("curve_covered", "step_covered"))
            fit = [f"{mid['unseen']:.2f}", f"{mid['unseen_gain']:+.2f}"]
            took = [f"{mid['dose']:.1f}", f"{100 * mid['dose_share']:.0f} %"]
            took += [f"{mid['seconds']:.1f}", f"{100 * mid['time_share']:.0f} %"]
            covered = [f"{count} ({100 * count / len(own):.0f} %)" for count in (curve, step)]
            cells.append([kind, peer, len(own), *fit, *took, *covered])
    lines = table([*heads.split("; "), "f covered", "step covered"], cells)
    ended = [line["ended"] for line in rows if line["peer"] == "ours, new"]
    lines.append(f"\nOurs, new, ended: {', '.join(f'{e} {ended.count(e)}' for e in dict.fromkeys(ended))}.")
    cpu = np.array([s for line in rows if line["peer"].startswith("ours") for s in line.get("cpu_s", [])])
    if cpu.size:
        half, most = np.quantile(cpu, [0.5, 0.99])
        lines.append(f"`decide`: {1e3 * half:.0f} ms of processor time in the middle, p99 {1e3 * most:.0f} ms.")
    return lines


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def main() -> None:
    """Print the tables."""
    made = parser(__doc__)
    made.add_argument("--patients", type=int, default=150, help="of each kind")
    made.add_argument("--seeds", type=int, default=80_000, help="the first")
    made.add_argument("--kinds", default="sigmoid,shaped")
    made.add_argument("--peers", default="paper; short; staircase; random pieces; particles; ours, new; ours, known")
    made.add_argument("--hidden", type=int, default=0, help="patients with one hidden effect")
    made.add_argument("--paper", type=int, default=0, help="trials of the paper's muscle")
    made.add_argument("--json", type=Path, help="every row goes here, one a line")
    made.add_argument("--rows", type=Path, help="print the table of rows that were written before")
    settings = made.parse_args()
    if settings.rows is not None:
        print(*medians(lines_of(settings.rows)), sep="\n")
        return
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    rows: list[dict[str, Any]] = []
    for seed in range(settings.seeds, settings.seeds + settings.patients):
        for kind in settings.kinds.split(","):
            rows += one(kind, seed, settings.peers)
            print(seed, kind, file=sys.stderr, flush=True)
        keep_lines(settings.json, rows)
    print(*(medians(rows) if rows else []), sep="\n")
    found: list[dict[str, Any]] = []
    for seed in range(settings.seeds, settings.seeds + settings.hidden):
        found.append(hidden(seed))
        print(json.dumps(found[-1]), file=sys.stderr, flush=True)
    print(*(told_of_hidden(found) if found else []), sep="\n")
    print(*of_papers_muscle(settings.paper, settings.seeds), sep="\n")


if __name__ == "__main__":
    main()
