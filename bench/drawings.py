"""Figures 4, 5 and 7 of the paper, redrawn from our own simulation and fits; writes docs/img/figure-*.svg."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.common import ROOT, pyplot
from stimrig import identify
from stimrig.identify import paper
from stimrig.identify.dynamics.linear import SecondOrder

FOLDER = ROOT / "docs" / "img"
TRIALS = 20
POINTS = 400
"""Points a line in a drawing: small files, nothing lost at their size."""


def run() -> None:
    """Draw all three."""
    plt = pyplot()
    FOLDER.mkdir(exist_ok=True)
    for draw in (figure_4, figure_5, figure_7):
        path = FOLDER / f"{draw.__name__.replace('_', '-')}.svg"
        figure = draw(plt)
        figure.savefig(path, metadata={"Date": None}, bbox_inches="tight")
        print(f"wrote {path.name} ({path.stat().st_size // 1024} kB)")


def figure_4(plt: Any) -> Any:
    """Input and output of a PRBS test and of a triangular ramp test, with the model's free run."""
    record, _ = paper.simulate(0.05, 1, 1600.0)
    predicted = identify.predict(identify.fit(record), record)
    names = np.array(record.segment_names)[record.segment]
    figure, axes = plt.subplots(2, 2, figsize=(8, 4), sharex="col")
    for column, (name, title) in enumerate((("prbs", "PRBS test"), ("ramp", "Triangular ramp test"))):
        rows = np.flatnonzero(names == name)
        rows = rows[:: max(rows.size // POINTS, 1)]
        time_s = record.time_s[rows] - record.time_s[rows[0]]
        axes[0, column].step(time_s, record.pulse_width_us[rows], where="post", color="#555", lw=0.8)
        axes[0, column].set_title(title)
        axes[1, column].plot(time_s, record.torque_nm[rows], color="#9bb", lw=0.8, label="measured")
        axes[1, column].plot(time_s, predicted[rows], color="#b30", lw=1.2, label="model, free run")
        axes[1, column].set_xlabel("time, s")
    axes[0, 0].set_ylabel("pulse width, µs")
    axes[1, 0].set_ylabel("torque, N·m")
    axes[1, 1].legend(frameon=False)
    return figure


def figure_5(plt: Any) -> Any:
    """The simulated muscle: recruitment curve and step response, with what is identified at 40 Hz and 0.10 N·m."""
    record, _ = paper.simulate(0.10, 1)
    model = identify.fit(record)
    curve, step = model.bands["recruitment"], model.bands["step_response"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
    width = np.linspace(0, 300, 101)
    left.fill_between(curve["pulse_width_us"], curve["lower"], curve["upper"], color="#fdc", label="95 % band")
    left.plot(curve["pulse_width_us"], curve["value"], color="#b30", lw=1.2, label="identified")
    left.plot(width, paper.recruitment(width), "k--", lw=1, label="true")
    left.set(xlabel="pulse width, µs", ylabel="f(u), N·m", title="recruitment curve")
    left.legend(frameon=False)
    true = SecondOrder(paper.TIME_CONSTANT_S, paper.DAMPING).step_response(step["time_s"])
    right.fill_between(step["time_s"], step["lower"], step["upper"], color="#fdc")
    right.plot(step["time_s"], step["value"], color="#b30", lw=1.2)
    right.plot(step["time_s"], true, "k--", lw=1)
    right.set(xlabel="time, s", title="step response of G")
    return figure


def figure_7(plt: Any) -> Any:
    """Best fit against noise: the paper's and ours on the noisy ramp, the ceiling, and ours on unseen input."""
    rows = paper.table1(TRIALS)["rows"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2), sharex=True)
    noise = paper.NOISE_NM
    colours = {
        "two-stage": "#06c",
        "ramp-deconvolution": "#393",
        "separable-least-squares": "#a6a",
        "maximum-likelihood": "#b30",
    }
    for method, colour in colours.items():
        mine = [row for row in rows if row["method"] == method]
        left.plot(noise, [row["ours"] for row in mine], color=colour, marker="o", ms=3, lw=1, label=method)
        right.plot(noise, [row["unseen"] for row in mine], color=colour, marker="o", ms=3, lw=1)
        if method in paper.PAPER:
            left.plot(noise, [value for value, _ in paper.PAPER[method]], color=colour, ls=":", lw=1)
    ceiling = [row["ceiling"] for row in rows if row["method"] == "two-stage"]
    left.plot(noise, ceiling, "k", lw=0.6, label="ceiling")
    left.plot([], [], "k:", lw=1, label="the paper")
    left.set(xlabel="noise, N·m", ylabel="best fit, %", title="noisy ramp", ylim=(85, 100.5))
    right.set(xlabel="noise, N·m", title="unseen input, without noise", ylim=(60, 101))
    left.legend(frameon=False, fontsize=7, loc="lower left")
    return figure
