"""Tests on the emulated rig in real time while its computer is taken away again and again.

    python -m bench.disturbed --tests 20 --seeds 86000 --way host --share 0.1 [--rigs 3] [--json FILE]

Ways: `idle` takes nothing. With `host` the processes of rig and service stand still, half of the times all of them and
half one of them, while the emulator goes on, as devices and patient do. With `machine` the emulator stands still with
them. `load` puts two busy processes on each core. Pauses come only while a test is played and fitted.

A seed names the muscle, the noise and the pattern of pauses. `sigmoid` patients have the curves of
`tests.harness.adaptive`, `shaped` ones are the emulator's `plain:SEED`, of eight shapes. "Unseen" is 100 % less the
best fit of the model's prediction to the clean torque of random levels; each seed is first played in the way `idle`,
and the ratio of both errors is told. `--idle FILE` takes those rows from an earlier run. Rigs beside each other take
time from one another: idle tests on more rigs than cores are not idle.

The emulator's electrodes tell which pulses were felt. Broken are limits of width, current, distance, rate and charge,
and the climb: after more than 0.25 s of dropped pulses the first is at most 50 µs wide, and each next one at most 50 µs
wider, until the planned width is reached.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bench.adaptive import paper_test, unseen_percent
from bench.common import in_processes, keep_lines, lines_of, parser, services, spread, table
from bench.pausing import WAYS, Disturber, Stood, Taken
from stimrig.api.client.errors import NotCompleted
from stimrig.hardware_sim.hidden.other_physics import draw_muscle
from stimrig.identify.model import Model
from stimrig.rig.limits import HARD_LIMITS
from tests.harness.adaptive import Muscle, sigmoid, sigmoid_of
from tests.harness.pauses import PATIENCE_S
from tests.harness.processes import control

PERSON = "BENCH"
RATE_HZ, CURRENT_MA = 40.0, 20.0
LEFT_OUT_S = 0.25
"""After more of dropped pulses the width climbs."""
ROUNDED_US = 1.0
COLUMNS = ("planned_time_s", "pulse_width_us", "written_time_s", "acknowledged_time_s", "status")
DROPPED = 2


def patient(kind: str, seed: int, folder: Path) -> tuple[str, Muscle]:
    """What the emulator is told of that patient; and the same muscle, for the figures."""
    if kind == "shaped":
        base = draw_muscle("plain", seed).base
        dynamics = (base.t_omega_s, base.zeta, 0.0)
        return f"plain:{seed}", Muscle(base.shape, base.table_nm, float(base.largest_width_us), *dynamics)
    muscle, curve = replace(sigmoid(seed), delay_s=0.0), sigmoid_of(seed)
    rows = {"a1": curve.gain, "a2": curve.a2, "a3": curve.a3}
    rows |= {"natural_period_s": muscle.time_constant_s, "damping_ratio": muscle.damping}
    path = folder / "patient.toml"
    path.write_text('patient = "paper"\n[parameters]\n' + "".join(f"{key} = {row!r}\n" for key, row in rows.items()))
    return str(path), muscle


def play(job: tuple[int, argparse.Namespace]) -> dict[str, Any]:
    """One test on services of its own; its row."""
    seed, settings = job
    row = {"seed": seed, **{name: getattr(settings, name) for name in ("way", "kind", "patients")}}
    try:
        with tempfile.TemporaryDirectory(prefix="disturbed-") as folder:
            told, muscle = patient(settings.patients, seed, Path(folder))
            with services("--patient", told, "--noise-seed", str(seed)) as (running, client):
                return row | played(running, client, muscle, seed, settings)
    except (Exception, SystemExit) as error:  # of the machine, of the client: a row like any other
        return row | {"completed": False, "reason": f"{type(error).__name__}: {error}"}


def played(running: Any, client: Any, muscle: Muscle, seed: int, settings: argparse.Namespace) -> dict[str, Any]:
    """What became of the test, and of its pulses."""
    limits = {"current_ma": CURRENT_MA, "max_pulse_width_us": muscle.top_us, "max_torque_nm": 30.0}
    client.make_participant(PERSON, limits)
    more = {"kind": "adaptive"} if settings.kind == "adaptive" else {}
    taken = Taken(*(getattr(settings, name) for name in ("way", "share", "shortest", "longest")))
    with Disturber(running, seed, taken, settings.rigs) as disturber:
        begun = lambda test: disturber.begin() if test["state"] == "running" else None  # noqa: E731
        try:
            test = client.run_test(PERSON, begun, **more)
        except NotCompleted as error:
            test = error.document
    stood = disturber.stood
    row: dict[str, Any] = {"pauses": len(stood), "paused_s": sum(one.ended_s - one.began_s for one in stood)}
    row["stood"] = [(round(one.began_s, 3), round(one.ended_s, 3), one.rig) for one in stood]
    row |= outcome(test) | wire(running, client, test, muscle, stood)
    if test["model_id"] is not None:
        model = Model.from_json(json.dumps(client.model_file(test["model_id"])))
        row["unseen"] = unseen_percent(muscle, model.predict, seed)
    return row


def outcome(test: dict[str, Any]) -> dict[str, Any]:
    """How the test ended, in the service's own words."""
    told, summary = test["adaptive"] or {}, test["summary"]
    decisions = told.get("decisions", [])
    return {
        "completed": test["state"] == "completed",
        "reason": test["reason"],
        "ended": told.get("ended", ""),
        "problem": told.get("problem", ""),
        "misfit": any(decision["kind"] == "misfit" for decision in decisions),  # the structure is the model's: false
        "refused": sum("refused" in decision for decision in decisions),
        "plan_ms": [decision["sample_to_plan_ms"] for decision in decisions if "sample_to_plan_ms" in decision],
        "seconds": summary.get("duration_s"),
        "dropped": summary.get("dropped_pulses", 0),
        "told_pauses": len(summary["pauses"]) if "pauses" in summary else None,
    }


def wire(running: Any, client: Any, test: dict[str, Any], muscle: Muscle, stood: list[Stood]) -> dict[str, Any]:
    """How late the pulses were, what they did to the muscle, and which limits they broke."""
    pulses = control(running.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"]
    names = ("monotonic_s", "width_us", "current_ma")
    felt = {name: np.array([pulse[name] for pulse in pulses if pulse["delivered"]]) for name in names}
    dose = float(np.sum(muscle.curve(felt["width_us"]))) / RATE_HZ
    row = {"dose": dose, "felt": felt["width_us"].size, "broken": broken(felt, muscle.top_us)}
    if test["recording_id"] is None:
        return row
    with h5py.File(io.BytesIO(client.recording(test["recording_id"]))) as file:
        sent = {name: np.asarray(file[f"pulses/{name}"]) for name in COLUMNS}
    row["broken"]["climb"] = climbs_broken(felt, sent)
    return row | lateness(felt, sent, stood)


def lateness(felt: dict[str, np.ndarray], sent: dict[str, np.ndarray], stood: list[Stood]) -> dict[str, Any]:
    """Of each written pulse, ms; and of those at which the rig's process did not stand still."""
    written = np.isfinite(sent["written_time_s"])
    at_s, due_s = sent["written_time_s"][written], sent["planned_time_s"][written]
    count = min(at_s.size, felt["monotonic_s"].size)
    zero_s = float(np.median(felt["monotonic_s"][:count] - at_s[:count])) if count else 0.0
    apart = np.ones(at_s.size, bool)
    for one in stood:
        if one.rig:
            apart &= (zero_s + at_s < one.began_s) | (zero_s + due_s > one.ended_s + 1.0 / RATE_HZ)
    late_ms = 1e3 * (at_s - due_s)
    ack_ms = 1e3 * (sent["acknowledged_time_s"][written] - at_s)
    rows = {"late_ms": late_ms, "late_apart_ms": late_ms[apart], "ack_ms": ack_ms[np.isfinite(ack_ms)]}
    return {"written": at_s.size} | {name: np.round(values, 3).tolist() for name, values in rows.items()}


def broken(felt: dict[str, np.ndarray], top_us: float) -> dict[str, int]:
    """How many of the pulses broke which limit."""
    at_s, width_us, current_ma = felt.values()
    charge_uc = np.r_[0.0, np.cumsum(width_us * current_ma) * 1e-3]
    first = np.searchsorted(at_s, at_s - 1.0, "right")  # of the pulses in the second that ends with each
    in_second = charge_uc[1:] - charge_uc[first]
    most = int(HARD_LIMITS["pulse_rate_hz"].hi)
    found = {
        "width": (width_us > top_us) | (current_ma > CURRENT_MA + 1e-6),
        "distance": np.diff(at_s) < HARD_LIMITS["pulse_interval_s"].lo - 1e-6,
        "rate": np.arange(1, at_s.size + 1) - first > most,
        "charge": in_second > HARD_LIMITS["charge_per_second_uc"].hi + 1e-6,
    }
    return {name: int(np.sum(rows)) for name, rows in found.items()}


def climbs_broken(felt: dict[str, np.ndarray], sent: dict[str, np.ndarray]) -> int:
    """Pulses that were too wide after a row of dropped ones."""
    index = np.flatnonzero(np.isfinite(sent["written_time_s"]))[: felt["width_us"].size]
    dropped = np.r_[0, np.cumsum(sent["status"] == DROPPED)]
    left_out_s = np.diff(dropped[index], prepend=0) / RATE_HZ
    rise_us, count, most_us = HARD_LIMITS["width_rise_us"].hi, 0, np.inf
    for at, width_us, planned_us in zip(left_out_s, felt["width_us"], sent["pulse_width_us"][index], strict=False):
        if at > LEFT_OUT_S:
            most_us = rise_us
        count += width_us > most_us + 1e-6
        most_us = width_us + rise_us if np.isfinite(most_us) and width_us < planned_us - ROUNDED_US else np.inf
    return int(count)


# ---- the table ----------------------------------------------------------------------------------------------


def figures(rows: list[dict[str, Any]], idle: list[dict[str, Any]]) -> dict[str, str]:
    """Of one way, by their names."""
    whole = [row for row in rows if row["completed"]]
    ended = Counter(row["ended"] or "as planned" for row in whole)
    return {
        "completed": f"{len(whole)} of {len(rows)}",
        "ended": ", ".join(f"{word} {count}" for word, count in ended.most_common()),
        "false misfits": str(sum(row.get("misfit", False) for row in rows)),
        **costs(whole),
        **errors(whole, idle),
        **on_the_wire([row for row in rows if "felt" in row]),
    }


def costs(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Of completed tests, % of the plain test of the same muscle."""
    found: dict[str, list[float]] = {"time": [], "dose": []}
    for row in rows:
        with tempfile.TemporaryDirectory() as folder:
            muscle = patient(row["patients"], row["seed"], Path(folder))[1]
        widths = paper_test(muscle.top_us, held_out=True)[0]
        found["time"].append(100.0 * row["seconds"] * RATE_HZ / widths.size)
        found["dose"].append(100.0 * row["dose"] * RATE_HZ / float(np.sum(muscle.curve(widths))))
    return {f"{name}, % of the plain test, median (worst)": middle(shares, "{:.0f}") for name, shares in found.items()}


def errors(rows: list[dict[str, Any]], idle: list[dict[str, Any]]) -> dict[str, str]:
    """Of models, and beside the idle test of the same seed."""
    own = {row["seed"]: 100.0 - row["unseen"] for row in rows if "unseen" in row}
    quiet = {row["seed"]: 100.0 - row["unseen"] for row in idle if "unseen" in row}
    ratios = [error / quiet[seed] for seed, error in own.items() if seed in quiet]
    return {
        "unseen error, %, median (worst)": middle(own.values(), "{:.2f}"),
        "of the idle test's, median (worst)": f"{middle(ratios, '{:.2f}')}, n = {len(ratios)}",
    }


def on_the_wire(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Lateness, dropped pulses and broken limits, of all pulses together."""
    told = [row["told_pauses"] for row in rows if row["told_pauses"] is not None]
    kinds = sum((Counter(row["broken"]) for row in rows), Counter())
    named = ", ".join(f"{kind} {count}" for kind, count in kinds.items() if count)
    times = {"late": "late_ms", "late, apart from the rig's pauses": "late_apart_ms", "ack": "ack_ms"}
    times |= {"sample to plan": "plan_ms"}
    return {
        **{f"{name}, ms, median / p99 / max": pooled(rows, key) for name, key in times.items()},
        "dropped pulses": str(sum(row["dropped"] or 0 for row in rows)),
        "pulses felt, broken limits": f"{sum(row['felt'] for row in rows)}, {named or 0}",
        "pauses": f"{sum(row['pauses'] for row in rows)}, {sum(row['paused_s'] for row in rows):.1f} s",
        "pauses that the summary tells": str(sum(told)) if told else "-",
    }


def pooled(rows: list[dict[str, Any]], key: str) -> str:
    """Of the values of all rows."""
    values = [value for row in rows for value in row.get(key, [])]
    return " / ".join(f"{ms:.2f}" for ms in spread(values, 1.0).values()) + f", n = {len(values)}" if values else "-"


def middle(values: Iterable[float], form: str) -> str:
    """Median, and the largest in brackets."""
    found = [*values]
    return f"{form.format(np.median(found))} ({form.format(max(found))})" if found else "-"


def page(rows: list[dict[str, Any]], idle: list[dict[str, Any]]) -> list[str]:
    """The table, a column for each way; and in words why tests were no good."""
    ways = [way for way in WAYS if any(row["way"] == way for row in rows)]
    cells = [figures([row for row in rows if row["way"] == way], idle) for way in ways]
    lines = table(["", *ways], ([name, *(cell[name] for cell in cells)] for name in cells[0]))
    for way in ways:
        for what in ("reason", "problem"):
            words = Counter(re.sub(r"\d+", "N", row.get(what) or "") for row in rows if row["way"] == way)
            lines += [f"- {way}, {what}, {count}: {word}" for word, count in words.most_common() if word]
    return lines


def said(row: dict[str, Any]) -> str:
    """A test in a line."""
    words = (row["ended"] or "as planned") if row["completed"] else row["reason"]
    paused = f"{row.get('pauses', 0)} pauses, {row.get('paused_s', 0.0):.1f} s"
    error = f"{100.0 - row['unseen']:.2f} %" if "unseen" in row else "none"
    return f"{row['seed']} {row['way']}: {words}; {row.get('dropped')} dropped; {paused}; unseen error {error}"


def run(jobs: list[tuple[int, argparse.Namespace]], rigs: int, keep: Callable[[list[Any]], None]) -> list[Any]:
    """The rows of all jobs, told as they come."""
    rows: list[Any] = []
    began_s = time.monotonic()
    for row in in_processes(play, jobs, rigs):
        rows.append(row)
        left_s = (time.monotonic() - began_s) / len(rows) * (len(jobs) - len(rows))
        print(f"{said(row)}; {len(rows)} of {len(jobs)}, {left_s / 60:.0f} min left", file=sys.stderr, flush=True)
        keep(rows)
    return rows


def main() -> None:
    """Play, and print the table."""
    made = parser(__doc__)
    made.add_argument("--tests", type=int, default=20)
    made.add_argument("--seeds", type=int, default=86_000, help="the first")
    made.add_argument("--way", choices=WAYS, default="host")
    made.add_argument("--share", type=float, default=0.1, help="of the time that is taken away")
    made.add_argument("--shortest", type=float, default=0.02, help="pause, s")
    made.add_argument("--longest", type=float, default=0.8, help=f"pause, s; below {PATIENCE_S:g}")
    made.add_argument("--rigs", type=int, default=1, help="beside each other")
    made.add_argument("--kind", choices=("adaptive", "default"), default="adaptive")
    made.add_argument("--patients", choices=("sigmoid", "shaped"), default="sigmoid")
    made.add_argument("--without-idle", action="store_true", help="do not play each seed in the way `idle` first")
    made.add_argument("--idle", type=Path, help="rows of the idle tests, of an earlier run")
    made.add_argument("--json", type=Path, help="every row goes here, one a line")
    given = made.parse_args()
    if not (0 < given.share < 1 and 0 < given.shortest <= given.longest < PATIENCE_S):
        made.error(f"0 < --share < 1, and 0 < --shortest <= --longest < {PATIENCE_S:g}")
    idle = [row for row in lines_of(given.idle) if (row["kind"], row["patients"]) == (given.kind, given.patients)]
    idle = [row for row in idle if row["way"] == "idle"]
    seeds = range(given.seeds, given.seeds + given.tests)
    quiet = argparse.Namespace(**{**vars(given), "way": "idle"})
    first = [] if given.way == "idle" or given.without_idle or idle else [(seed, quiet) for seed in seeds]
    rows = run([*first, *((seed, given) for seed in seeds)], given.rigs, lambda rows: keep_lines(given.json, rows))
    print(*page(rows, idle or [row for row in rows if row["way"] == "idle"]), sep="\n")


if __name__ == "__main__":
    main()
