"""Figures of identification on seeds that nothing was developed on; writes docs/results/identification.md.

python -m bench goals
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import RESULTS, in_processes, table, written_by
from stimrig import identify
from stimrig.identify import paper
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.estimation.uncertainty import prediction_band
from stimrig.identify.paper import simulate
from stimrig.identify.records.record import Record
from tests.harness.patients import Patient, make_record

TARGET = RESULTS / "identification.md"
ACCURACY_SEEDS = range(710_000, 710_040)
PATIENT_SEEDS = range(720_000, 720_300)
CALIBRATION_SEEDS = range(730_000, 730_300)
OTHER_SEEDS = range(740_000, 740_150)
NOISE_NM = (0.0, 0.02, 0.04, 0.06, 0.08, 0.10)


DELAY = "electromechanical_delay"


def fitted(record: Record, patient: Patient, extra: bool = False) -> identify.Model:
    """The structure that holds the patient: with a delay where it is longer than a sample, and always if `extra`."""
    longer = patient.delay_s > 1.0 / record.sample_rate_hz
    return identify.fit(record, effects=[f"{DELAY}:delay"] if longer or extra else [])


def record_of(patient: Patient, rng: np.random.Generator, rate_hz: float, noise_nm: float) -> tuple[Record, np.ndarray]:
    """A record of this patient in the paper's test, with a baseline, and its clean torque."""
    baseline_nm = float(rng.uniform(-1, 1))
    return make_record(
        patient, rng, rate_hz=rate_hz, noise_nm=noise_nm, baseline_nm=baseline_nm, pulses=paper.protocol()
    )


def delay_of(model: identify.Model) -> tuple[float, float]:
    """Delay in all and its standard deviation, s."""
    assert model.covariance is not None
    names = [name for name in ("delay_s", f"{DELAY}.delay_s") if name in model.covariance.names]
    at = [model.covariance.names.index(name) for name in names]
    return float(model.covariance.values[at].sum()), float(np.sqrt(model.covariance.matrix[np.ix_(at, at)].sum()))


def run() -> None:
    """Measure, print, write."""
    lines = [
        "# Identification: figures",
        "",
        written_by("python -m bench goals"),
        "Seeds here were not used in development.",
        "",
    ]
    for part in (accuracy, patients, calibration, other_curves, speed):
        begin = time.perf_counter()
        found = part()
        print(*found, f"({time.perf_counter() - begin:.0f} s)", "", sep="\n", flush=True)
        lines += [*found, ""]
    TARGET.write_text("\n".join(lines))


def one_accuracy(task: tuple[float, float, int]) -> tuple[float, float, float]:
    """Clean ramp %, unseen %, and points above the true ceiling, of one record of the paper's muscle."""
    rate, noise, seed = task
    found = paper.score(*simulate(noise, seed, rate), "maximum-likelihood")
    return found["clean"], found["unseen"], found["noisy"] - found["ceiling"]


def accuracy() -> list[str]:
    """The paper's muscle at every noise level, 40 and 1600 samples a second."""
    lines = [
        f"## Accuracy (the paper's muscle, {len(ACCURACY_SEEDS)} records each)",
        "",
        "Clean ramp and unseen multi-level input, best fit % (mean, smallest); worst of the noisy fit beside the true",
        "system's own fit to the same noise, points.",
        "",
    ]
    rows = []
    for noise in NOISE_NM:
        cells = []
        for rate in (40.0, 1600.0):
            seeds = ACCURACY_SEEDS if noise else ACCURACY_SEEDS[:1]
            found = np.array([*in_processes(one_accuracy, [(rate, noise, seed) for seed in seeds], None)])
            cells += [f"{found[:, column].mean():.3f} ({found[:, column].min():.2f})" for column in (0, 1)]
            cells += [f"{found[:, 2].min():+.3f}"]
        rows.append([f"{noise:.2f}", *cells])
    heads = "noise, N·m; 40 Hz: ramp; unseen; beside ceiling; 1600 Hz: ramp; unseen; beside ceiling"
    return lines + table(heads.split("; "), rows)


def one_patient(seed: int) -> dict[str, Any]:
    """One simulated patient: did the fit converge, and does a bad fit say so?"""
    rng = np.random.default_rng(seed)
    patient = Patient.draw(rng)
    rate, noise = float(rng.choice([40, 100, 400, 1000, 1600])), float(rng.choice([0.01, 0.03, 0.1]))
    record, clean = record_of(patient, rng, rate, noise)
    try:
        model = fitted(record, patient)
    except identify.IdentifyError as error:
        return {"failed": str(error)}
    used = ~record.held_out
    true_ceiling = best_fit_percent(record.torque_nm[used], clean[used])
    unseen = best_fit_percent(clean[record.held_out], identify.predict(model, record)[record.held_out])
    return {
        "failed": "",
        "converged": model.quality["gates"]["converged"]["passed"],
        "gap": true_ceiling - model.fit["fit_percent"],
        "verdict": model.quality["verdict"],
        "unseen": unseen,
        "t_error": abs(model.linear.time_constant_s / patient.time_constant_s - 1),
    }


def patients() -> list[str]:
    """300 simulated patients."""
    found = [*in_processes(one_patient, PATIENT_SEEDS, None)]
    fitted = [f for f in found if not f["failed"]]
    failed = len(found) - sum(f["converged"] for f in fitted)
    bad = [f for f in fitted if f["gap"] > 1.0]
    silent = [f for f in bad if f["verdict"] == "usable"]
    verdicts = {v: sum(f["verdict"] == v for f in fitted) for v in ("usable", "usable with care", "not usable")}
    unseen = np.array([f["unseen"] for f in fitted])
    error = np.array([f["t_error"] for f in fitted])
    return [
        f"## {len(found)} simulated patients",
        "",
        "Gain 1.5-15 N·m, 10-90 % rise in 10-150 µs, threshold, Tω 0.1-0.6 s, ζ 0.6-1.2, delay 0-60 ms (fitted with "
        "`electromechanical_delay` where it is longer than a sample); 40 to 1600",
        "samples a second, noise 0.01, 0.03 or 0.10 N·m.",
        "",
        f"- did not converge or refused: {failed}",
        f"- more than 1 point under the ceiling: {len(bad)}; of these silent: {len(silent)}",
        f"- verdicts: {', '.join(f'{v} {n}' for v, n in verdicts.items())}",
        f"- unseen input, clean: median {np.median(unseen):.2f} %, 5th percentile {np.percentile(unseen, 5):.2f} %",
        f"- error of Tω: median {100 * np.median(error):.2f} %, 95th percentile {100 * np.percentile(error, 95):.2f} %",
    ]


def one_calibration(seed: int) -> dict[str, float]:
    """Shares of the 95 % bands of one record that cover the truth."""
    rng = np.random.default_rng(seed)
    patient = Patient.draw(rng)
    record, clean = record_of(patient, rng, 400.0, 0.05)
    model = fitted(record, patient)
    assert model.covariance is not None
    late_s = (
        patient.delay_s if not model.effects else patient.delay_s - model.effects[0]["parameters"]["delay_s"]["value"]
    )
    linear = SecondOrder(patient.time_constant_s, patient.damping, late_s)
    curve, step = model.bands["recruitment"], model.bands["step_response"]
    truth, response = patient.recruitment(curve["pulse_width_us"]), linear.step_response(step["time_s"])
    low, high = prediction_band(model, record)

    def share(value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
        return float(np.mean((value >= lower - 1e-12) & (value <= upper + 1e-12)))

    alarm = model.residual_tests
    early = step["time_s"] > max(late_s, 0.0) + 0.02
    inside = {
        "f(u), at any one width": share(truth[1:], curve["lower"][1:], curve["upper"][1:]),
        "f(u), the whole curve": float(share(truth, curve["whole_lower"] - 1e-9, curve["whole_upper"] + 1e-9) == 1),
        "step response, at any one time": share(response[early], step["lower"][early], step["upper"][early]),
        "step response, the whole curve": float(
            share(response[early], step["whole_lower"][early], step["whole_upper"][early]) == 1
        ),
        "prediction, at any one time": share(clean, low, high),
    }
    delay_s, sd = delay_of(model)
    inside["delay_s"] = float(abs(delay_s - patient.delay_s) <= 1.96 * sd)
    for name in ("time_constant_s", "damping"):
        z = model.covariance.values[model.covariance.names.index(name)] - getattr(patient, name)
        inside[name] = float(abs(z) <= 1.96 * model.covariance.sd(name))
    for name in ("whiteness", "structure"):
        inside[f"false alarms of the {name} test at 1 %"] = float(not alarm[name]["passed"])
    return inside


def calibration() -> list[str]:
    """How often 95 % bands cover the truth."""
    found = [*in_processes(one_calibration, CALIBRATION_SEEDS, None)]
    lines = [
        f"## Do 95 % bands cover the truth? ({len(found)} records, 400 Hz, noise 0.05 N·m, patients drawn as above)",
        "",
    ]
    return lines + [f"- {key}: {100 * np.mean([f[key] for f in found]):.1f} %" for key in found[0]]


class TwoPools(Patient):
    """A muscle whose curve has two steps: two groups of fibres with thresholds of their own."""

    def recruitment(self, width_us: np.ndarray) -> np.ndarray:
        """Steady torque, N·m: 55 % of it as drawn, 45 % with a threshold 90 µs higher."""
        later = np.maximum(np.asarray(width_us, float) - 90.0, 0.0)
        return 0.55 * super().recruitment(width_us) + 0.45 * super().recruitment(later)


class SharpThreshold(Patient):
    """A muscle whose curve sets out at its threshold with a corner."""

    def recruitment(self, width_us: np.ndarray) -> np.ndarray:
        """Steady torque, N·m: nothing up to the threshold, then an exponential approach to the plateau."""
        threshold_us = np.log(self.a3) / self.a2 - 2.2 / self.a2
        over_us = np.maximum(np.asarray(width_us, float) - max(threshold_us, 20.0), 0.0)
        return self.gain * (1 - np.exp(-over_us * self.a2 / 2))


def one_other_curve(task: tuple[type[Patient], int]) -> tuple[float, float]:
    """Share of widths inside the pointwise band, and whether the whole curve is inside the whole band."""
    kind, seed = task
    rng = np.random.default_rng(seed)
    patient = kind(**vars(Patient.draw(rng)))
    record, _ = record_of(patient, rng, 400.0, 0.05)
    curve = fitted(record, patient).bands["recruitment"]
    truth = patient.recruitment(curve["pulse_width_us"])
    inside = (truth[1:] >= curve["lower"][1:]) & (truth[1:] <= curve["upper"][1:])
    whole = (truth >= curve["whole_lower"] - 1e-9) & (truth <= curve["whole_upper"] + 1e-9)
    return float(np.mean(inside)), float(np.all(whole))


def other_curves() -> list[str]:
    """How often the bands of f(u) cover curves that are no sigmoid."""
    lines = [
        f"## Bands of f(u) for other curves ({len(OTHER_SEEDS)} records of each, 400 Hz, noise 0.05 N·m)",
        "",
        "The patients above have S-shaped curves. Two pools: two groups of fibres with different thresholds. Sharp",
        "threshold: nothing below the threshold, then an exponential approach to the plateau.",
        "",
    ]
    for kind, name in ((TwoPools, "two pools"), (SharpThreshold, "sharp threshold")):
        found = [*in_processes(one_other_curve, [(kind, seed) for seed in OTHER_SEEDS], None)]
        one, whole = 100 * np.mean(found, axis=0)
        lines.append(f"- {name}: at any one width {one:.1f} %, the whole curve {whole:.1f} %")
    return lines


def speed() -> list[str]:
    """Time of a fit, warm, one core; and of the command as a whole."""
    load = f", load average {os.getloadavg()[0]:.1f} meanwhile" if hasattr(os, "getloadavg") else ""
    lines = [f"## Time (one core, uncertainty included{load})", ""]
    for rate in (40.0, 1600.0):
        record, _ = simulate(0.05, 1, rate)
        times = []
        for _ in range(40):
            begin = time.perf_counter()
            identify.fit(record)
            times.append(1e3 * (time.perf_counter() - begin))
        rows = record.time_s.size
        lines.append(
            f"- fit of {rows / rate:.1f} s from {rate:g} Hz ({rows} rows), warm: median {np.median(times):.1f} ms, "
            f"shortest {min(times):.1f} ms"
        )
    record, _ = simulate(0.05, 1, 1600.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        names = np.array(record.segment_names)[record.segment]
        columns = (record.time_s.round(6), record.pulse_width_us.round(3), record.torque_nm.round(5), names)
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["time_s", "pulse_width_us", "torque_nm", "segment"])
            writer.writerows(list(zip(*columns, strict=True))[:70_000])
        lines.append(whole_process("`stimrig --help`", ["--help"], 5))
        lines.append(whole_process("`stimrig fit` on a CSV of 70 000 rows", ["fit", str(path), "--json"], 5))
        empty = os.environ | {"NUMBA_CACHE_DIR": folder}
        lines.append(whole_process("`stimrig diagnose` of it, nothing compiled yet", ["diagnose", str(path)], 1, empty))
    return lines


def whole_process(words: str, arguments: list[str], runs: int, environment: dict[str, str] | None = None) -> str:
    """A line on a verb: medians of the time that passed and of the processor's time, its children's counted."""
    wall, processor, state = [], [], ""
    for _ in range(runs):
        begin, before = time.perf_counter(), os.times()
        command = [sys.executable, "-m", "stimrig", *arguments]
        done = subprocess.run(command, capture_output=True, check=False, env=environment)
        after = os.times()
        wall.append(time.perf_counter() - begin)
        processor.append(sum(after[2:4]) - sum(before[2:4]))
        state = "" if done.returncode == 0 else f" (exit {done.returncode})"
    return f"- {words}: {np.median(wall):.2f} s, {np.median(processor):.2f} s of the processor{state}"
