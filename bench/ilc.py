"""`python -m bench.ilc [--speed N] [--trials N]`: the controller of `examples/ilc_controller.py` on the emulated rig.

Starts the whole rig for each muscle, runs the pre-session test, approves, and lets the controller learn. Writes
docs/results/ilc.md and docs/img/ilc.svg.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import ROOT, bench_parser, pyplot, reveal, services, table, written_by
from examples import ilc_controller as ilc

SEEDS = (59, 29)
"""Muscles with a hidden effect that were not looked at in development (that was on 14, 20 and 17)."""
WITH_MODEL = "identified model"
STATIC = "static start"
PAPER = "the paper's muscle"


def case(emulate: str, speed: float, trials: int, work: Any, widest_us: float = 300.0) -> dict[str, Any]:
    """Start a rig, make the first model, and hand over."""
    with services(*emulate.split(), "--speed", f"{speed:g}", "--rate-hz", "400") as (_, client):
        service = Patient(client, "ILC")
        client.make_participant("ILC", {"current_ma": 20.0, "max_pulse_width_us": widest_us, "max_torque_nm": 30.0})
        test = client.run_test("ILC")
        approve(service, test["model_id"])
        return work(service, test, trials)


class Patient(ilc.Service):
    """A controller with a person beside it, who re-arms after a fault (a busy machine) and has the trial repeated."""

    repeated = 0

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As the controller's, up to ten times."""
        for _ in range(10):
            self.client.participant(self.participant)  # a trial is a decision: on what the person sees now
            try:
                return super().play(widths_us)
            except (ilc.HaltedError, ilc.ServiceError) as error:
                print(f"  repeated: {error}", file=sys.stderr)
                self.repeated += 1
                time.sleep(2)
                self.client.post("/v1/rearm")
        raise SystemExit("the rig does not stay up")


def approve(service: ilc.Service, model_id: str) -> None:
    """The person's part."""
    service.client.approve(model_id, "bench")


def one_run(
    service: Patient, test: dict[str, Any], trials: int, law: str, static: bool, method: str = ""
) -> dict[str, Any]:
    """One law from one start, with the approved model or with that of another method."""
    model = service.fetch()
    reference = ilc.Reference.reach(0.6 * float(model["recruitment"]["inverse"]["torque_nm"][-1]))
    used = ramp_deconvolution(service, test) if method else model
    done = ilc.learn(service, used, reference, law, trials, static)
    outcome: dict[str, Any] = {"reference": reference, "trials": done}
    if not static:
        repeats = [service.play(done[-1].widths_us)[0] for _ in range(3)]
        outcome["floor"] = 100 * float(np.sqrt(np.mean(np.var(repeats, axis=0, ddof=1)))) / reference.rms_nm
    return outcome | {"repeated": service.repeated}


RUNS = {
    f"{WITH_MODEL}, norm-optimal": {"law": "norm-optimal", "static": False},
    f"{WITH_MODEL}, norm-optimal, {STATIC}": {"law": "norm-optimal", "static": True},
    f"{WITH_MODEL}, phase lead, {STATIC}": {"law": "phase-lead", "static": True},
    f"ramp deconvolution, norm-optimal, {STATIC}": {"law": "norm-optimal", "static": True, "method": "ramp"},
}


def ramp_deconvolution(service: ilc.Service, test: dict[str, Any]) -> dict[str, Any]:
    """The same record, identified as rigs do today."""
    with tempfile.TemporaryDirectory() as folder:
        data, model = Path(folder) / "first.h5", Path(folder) / "MODEL.json"
        data.write_bytes(service.client.recording(test["recording_id"]))
        words = ["fit", str(data), "--method", "ramp-deconvolution", "-o", str(model)]
        command = [sys.executable, "-m", "stimrig", *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        return json.loads(model.read_text())


def knowing(service: Patient, test: dict[str, Any], trials: int, peak_nm: float, effects: list[str]) -> dict[str, Any]:
    """With the base model, or with what was hidden added; each on a muscle from its beginning, as what tires would
    burden a second run."""
    if effects:
        why = "the bench knows what was hidden"
        version = service.client.add_effects(test["model_id"], effects, force=True, reason=why)
        approve(service, version["id"])
    reference = ilc.Reference.reach(peak_nm)
    done = ilc.learn(service, service.fetch(), reference, "norm-optimal", trials)
    return {"reference": reference, "trials": done, "repeated": service.repeated}


def main() -> None:
    """All cases, the page and the drawing."""
    parser = bench_parser(__doc__)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="*", default=list(SEEDS))
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    parser.add_argument("--jobs", type=int, default=2, help="rigs at a time")
    parser.add_argument("--only-hidden", action="store_true")
    options = parser.parse_args()
    began = time.time()
    wanted: dict[str, dict[str, Any]] = {}
    if not options.only_hidden:
        wanted[PAPER] = {name: partial(case, "", work=partial(one_run, **run)) for name, run in RUNS.items()}
    for seed in options.seeds:
        hides = reveal(seed)
        effects, base = hides["effects"], hides["base"]
        emulate, widest_us, peak_nm = f"--hidden {seed}", base["largest_width_us"], 0.6 * base["largest_torque_nm"]
        wanted[f"hidden effect, seed {seed} ({', '.join(effects)})"] = {
            run: partial(case, emulate, widest_us=widest_us, work=partial(knowing, peak_nm=peak_nm, effects=added))
            for run, added in (("before", []), (f"after adding {', '.join(effects)}", effects))
        }
    cases = play_all(wanted, options)
    draw(options.out / "img" / "ilc.svg", cases)
    words = page(cases, options.speed, time.time() - began)
    (options.out / "results" / "ilc.md").write_text(words, "utf-8")
    print(words)


def play_all(wanted: dict[str, dict[str, Any]], options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Every run on a rig of its own; one that its rig did not survive is left out and said so."""
    with ThreadPoolExecutor(options.jobs) as pool:
        futures = {
            (name, run): pool.submit(work, speed=options.speed, trials=options.trials)
            for name, runs in wanted.items()
            for run, work in runs.items()
        }
    cases: dict[str, dict[str, Any]] = {}
    for (name, run), future in futures.items():
        if future.exception() is not None:
            print(f"{name}, {run}: {future.exception()}", file=sys.stderr)
            continue
        outcome = future.result()
        case_ = cases.setdefault(name, {"reference": outcome["reference"], "runs": {}, "repeated": 0})
        case_["runs"][run] = outcome["trials"]
        case_["repeated"] += outcome["repeated"]
        case_ |= {"floor": outcome["floor"]} if "floor" in outcome else {}
    return cases


def page(cases: dict[str, dict[str, Any]], speed: float, seconds: float) -> str:
    """The figures as a page."""
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    lines = [
        "# Learning with the model",
        "",
        f"{written_by('python -m bench.ilc')} `examples/ilc_controller.py` uses the REST client alone; the rig is "
        f"emulated, at {speed:g} times the speed of the world; "
        f"{seconds:.0f} s in all, load average {load}.",
        "",
        "Error of a trial: rms of reference minus torque (means over a pulse's period), % of the reference's rms. The "
        "reference is ten seconds of minimum-jerk moves up to 60 % of the largest torque. *Static start*: the first "
        "trial inverts f alone, as if there were no G, so that there is something to learn.",
        "",
        "![Error over trials](../img/ilc.svg)",
    ]
    for name, outcome in cases.items():
        lines += ["", f"## {name[0].upper()}{name[1:]}", ""]
        lines.append(f"Reference {outcome['reference'].rms_nm:.2f} N·m rms.")
        if "floor" in outcome:
            lines.append(
                f"The same pulses played three times differ by {outcome['floor']:.2f} %: nothing is learnt below that."
            )
        lost = sum(trial.lost_pulses for trials in outcome["runs"].values() for trial in trials)
        lines.append(
            f"Pulses dropped because the host was late: {lost}; trials repeated after a fault: {outcome['repeated']}."
        )
        count = len(next(iter(outcome["runs"].values())))
        errors = [[run, *(f"{trial.error_percent:.2f}" for trial in trials)] for run, trials in outcome["runs"].items()]
        lines += ["", *table(["trial", *map(str, range(1, count + 1))], errors)]
    return "\n".join(lines) + "\n"


def draw(path: Path, cases: dict[str, dict[str, Any]]) -> None:
    """Error over trials, a panel for each muscle."""
    figure, axes = pyplot().subplots(1, len(cases), figsize=(3.6 * len(cases) + 2, 3.8), sharey=True, squeeze=False)
    for axis, (name, outcome) in zip(axes[0], cases.items(), strict=True):
        for run, trials in outcome["runs"].items():
            dashes = "--" if STATIC in run else "-"
            errors = [trial.error_percent for trial in trials]
            axis.semilogy(range(1, len(errors) + 1), errors, f"o{dashes}", ms=3, lw=1.2, label=run)
        axis.axhline(5, color="grey", lw=0.8)
        if "floor" in outcome:
            axis.axhspan(0.1, outcome["floor"], color="#eee")
        axis.set_title(name.replace(" (", "\n("), fontsize=9)
        axis.set_xlabel("trial")
        axis.legend(fontsize=6.5)
    axes[0][0].set_ylabel("error (% of the reference's rms)")
    axes[0][0].set_ylim(0.5, 150)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
