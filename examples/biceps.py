"""Measured human biceps: from pulse times and force to a record, a fit and a drawing.

    python examples/biceps.py FOLDER [--svg FILE]

FOLDER holds `force.csv` (train, time_s, force_n) and `pulses.csv` (time_s of each pulse): 20 trains of about 30 pulses
of one width and one current, elbow held still, force at 1 kHz. From the public repository Kev1CO/cocofest_archive, MIT
License, Copyright (c) 2023 Kev1CO. The pulse width never changes, so the data tell dynamics, not recruitment. Force
stands where the library writes torque: all numbers are N, not N·m.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from stimrig import identify
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.records.record import Record

WIDTH_US = 300.0
"""As a file name at the origin suggests; any constant does, since it never changes."""
SAMPLE_HZ = 1000.0
REST_S = 1.0
"""Rest put before each train: what was between the trains wasn't recorded."""


def read(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Times and forces of each train, and all pulse times, s and N."""
    trains: dict[int, list[tuple[float, float]]] = {}
    with (folder / "force.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            trains.setdefault(int(row["train"]), []).append((float(row["time_s"]), float(row["force_n"])))
    with (folder / "pulses.csv").open(newline="") as file:
        pulses = np.array([float(row["time_s"]) for row in csv.DictReader(file)])
    table = [np.array(rows) for rows in trains.values()]
    return [t[:, 0] for t in table], [t[:, 1] for t in table], pulses


def pulse_train(pulses: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mean interval within trains, s; first and last pulse of each train, s.

    Pulses came every 28 to 36 ms; a train is put on even slots of the mean interval, right to a few ms.
    """
    gaps = np.diff(pulses)
    breaks = np.flatnonzero(gaps > 0.2)
    interval = float(np.mean(gaps[gaps < 0.2]))
    return interval, pulses[np.r_[0, breaks + 1]], pulses[np.r_[breaks, pulses.size - 1]]


def record_of(folder: Path, validate_from: int = 15) -> tuple[Record, list[slice]]:
    """One record of all trains, each on its own slots of the pulse grid; from `validate_from` on they are held out."""
    times, forces, pulses = read(folder)
    interval, first, last = pulse_train(pulses)
    parts, slices, start, done = [], [], 0.0, 0
    for number, (time_s, force) in enumerate(zip(times, forces, strict=True)):
        begin = first[np.argmin(np.abs(first - time_s[0]))]
        end = last[np.argmin(np.abs(last - time_s[0] - 1.0))]
        rest = round(REST_S / interval) * interval
        size = int(rest * SAMPLE_HZ)
        # The muscle is at rest before a train, as the force at its first sample says.
        quiet = start + rest - np.arange(size, 0, -1) / SAMPLE_HZ
        train_s = start + rest + (time_s - begin)
        # The train ends one interval after its last pulse.
        width = np.where(time_s < end + interval, WIDTH_US, 0.0)
        name = "validate" if number >= validate_from else "train"
        after_rest = train_s > quiet[-1] + 0.5 / SAMPLE_HZ
        parts.append((quiet, np.zeros(size), np.full(size, force[0]), ["rest"] * size))
        parts.append((train_s[after_rest], width[after_rest], force[after_rest], [name] * int(after_rest.sum())))
        slices.append(slice(done + size, done + size + int(after_rest.sum())))
        done += size + int(after_rest.sum())
        start = np.ceil((train_s[-1] + 0.002) / interval) * interval
    columns = [np.concatenate([part[i] for part in parts]) for i in range(3)]
    labels = np.concatenate([part[3] for part in parts])
    return Record.from_arrays(*columns, labels, pulse_rate_hz=1.0 / interval), slices


def main() -> None:
    """Fit, tell, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--svg", type=Path)
    options = parser.parse_args()
    record, trains = record_of(options.folder)
    print(f"{record.pulse_rate_hz:.2f} pulses a second, {record.time_s.size} samples, {len(trains)} trains")
    model = identify.fit(record)
    predicted = identify.predict(model, record)
    linear = model.linear
    print(f"second order: T {linear.time_constant_s:.3f} s, damping {linear.damping:.2f}, delay {linear.delay_s:.3f} s")
    print(f"fit {model.fit['fit_percent']:.1f} %, held-out trains {model.fit['held_out_fit_percent']:.1f} %")
    print(f"verdict: {model.quality['verdict']}")
    for reason in model.quality["reasons"]:
        print(f"  {reason}")
    levels = []
    for rows in trains:
        shape, force = predicted[rows], record.torque_nm[rows]
        levels.append(float(shape @ force / (shape @ shape)))
    scaled = predicted.copy()
    for rows, level in zip(trains, levels, strict=True):
        scaled[rows] *= level
    inside = np.concatenate([np.arange(rows.start, rows.stop) for rows in trains])
    plain = best_fit_percent(record.torque_nm[inside], predicted[inside])
    share = best_fit_percent(record.torque_nm[inside], scaled[inside])
    print(
        f"gain from train to train: {min(levels):.2f} to {max(levels):.2f} of the mean; "
        f"within trains {plain:.1f} %, with one gain a train {share:.1f} %"
    )
    try:
        added = identify.fit(record, effects=["asymmetric_relaxation"])
        both = identify.predict(added, record)
        used = ~record.held_out
        print(
            f"with asymmetric_relaxation: fit {best_fit_percent(record.torque_nm[used], both[used]):.1f} %, held-out "
            f"{best_fit_percent(record.torque_nm[record.held_out], both[record.held_out]):.1f} %"
        )
        for effect in added.effects:
            print(f"  {effect['id']}: {effect.get('parameters')}")
    except identify.IdentifyError as error:
        print(f"asymmetric_relaxation: {error}")
    if options.svg:
        draw(record, predicted, scaled, trains, options.svg)


def draw(record: Record, predicted: np.ndarray, scaled: np.ndarray, trains: list[slice], path: Path) -> None:
    """The first, a middle and the last train."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "stimrig", "font.size": 9, "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), sharey=True)
    for axis, number in zip(axes, (0, len(trains) // 2, len(trains) - 1), strict=True):
        rows = np.arange(trains[number].start, trains[number].stop)[::5]
        time_s = record.time_s[rows] - record.time_s[rows[0]]
        axis.plot(time_s, record.torque_nm[rows], color="#9bb", label="measured")
        axis.plot(time_s, predicted[rows], color="#b30", lw=1, label="model")
        axis.plot(time_s, scaled[rows], color="#b30", lw=1, ls=":", label="own gain for each train")
        axis.set(title=f"train {number}", xlabel="time, s")
    axes[0].set_ylabel("force, N")
    axes[0].legend(frameon=False, fontsize=7)
    figure.savefig(path, metadata={"Date": None}, bbox_inches="tight")


if __name__ == "__main__":
    main()
