"""The paper's simulated muscle (section V) and its Table I: best-fit rates at six noise levels, printed and computed.

The muscle is the sigmoid (35) and an underdamped second order of unit gain. In addition to the fit on the noisy ramp:
the best fit that the noise allows, the fit to the torque of the ramp without noise, and the fit on a multi-level input
that was not fitted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.fitting import fit
from stimrig.identify.problem.predict import predict
from stimrig.identify.records.record import HELD_OUT, Record

A1_NM, A2_PER_US, A3 = 6.8994, 0.0410, 2389.7
TIME_CONSTANT_S, DAMPING = 0.5284, 0.6369
TOP_US = 300.0
PULSE_RATE_HZ = 40.0


def recruitment(width_us: np.ndarray) -> np.ndarray:
    """f(u) of equation (35), N·m."""
    power = np.exp(A2_PER_US * np.asarray(width_us, float))
    return A1_NM * (power - 1.0) / (power + A3)


def torque(width_us: np.ndarray, sample_rate_hz: float) -> np.ndarray:
    """Clean torque at the samples for one pulse width an interval, from rest, N·m.

    It uses scipy's discretisation for a held input, so that the simulation does not depend on `identify.dynamics`.
    """
    from scipy.signal import cont2discrete, lfilter

    transfer = ([1.0], [TIME_CONSTANT_S**2, 2 * DAMPING * TIME_CONSTANT_S, 1.0])
    b, a = cont2discrete(transfer, 1.0 / sample_rate_hz, method="zoh")[:2]  # type: ignore
    each = round(sample_rate_hz / PULSE_RATE_HZ)
    return np.asarray(lfilter(np.ravel(b), np.ravel(a), np.repeat(recruitment(width_us), each)))


def prbs() -> np.ndarray:
    """Maximum-length sequence of 127 levels, 0 or the top, each held for 5 pulses; feedback from x⁷ + x⁶ + 1."""
    state, levels = [1] * 7, []
    for _ in range(127):
        levels.append(state[-1])
        state = [state[6] ^ state[5], *state[:-1]]
    return np.repeat(np.array(levels, float) * TOP_US, 5)


def ramp() -> np.ndarray:
    """Triangle 0 to top to 0, in 10 s."""
    up = np.linspace(0.0, TOP_US, round(5.0 * PULSE_RATE_HZ), endpoint=False)
    return np.r_[up, TOP_US - up]


def multilevel() -> np.ndarray:
    """Random levels over the whole range for 15 s, each held for 20 pulses; for validation only."""
    size = round(15.0 * PULSE_RATE_HZ)
    return np.repeat(np.random.default_rng(0).uniform(0.0, TOP_US, size // 20 + 1), 20)[:size]


def protocol() -> tuple[np.ndarray, list[str]]:
    """Width and segment name of each pulse: rest, PRBS, rest, ramp, rest, validate, rest (48 s)."""
    parts = [
        ("rest", np.zeros(40)),
        ("prbs", prbs()),
        ("rest", np.zeros(200)),
        ("ramp", ramp()),
        ("rest", np.zeros(120)),
        (HELD_OUT, multilevel()),
        ("rest", np.zeros(40)),
    ]
    return np.concatenate([part for _, part in parts]), [name for name, part in parts for _ in part]


NOISE_NM = (0.0, 0.02, 0.04, 0.06, 0.08, 0.10)
PAPER: dict[str, tuple[tuple[float, float], ...]] = {
    "two-stage": ((99.98, 0.0), (99.07, 0.07), (98.14, 0.02), (97.27, 0.03), (96.31, 0.15), (95.33, 0.22)),
    "ramp-deconvolution": ((91.24, 0.0), (91.19, 0.0), (91.07, 0.0), (90.86, 0.0), (90.58, 0.0), (90.24, 0.0)),
    "separable-least-squares": ((92.06, 0.0), (92.01, 0.01), (91.87, 0.0), (91.64, 0.0), (91.32, 0.01), (90.94, 0.0)),
}
"""Best-fit rates, % and standard deviation, as printed."""
OURS = ("two-stage", "ramp-deconvolution", "separable-least-squares", "maximum-likelihood")
FIRST_SEED = 20_000


def simulate(noise_nm: float, seed: int, sample_rate_hz: float = 40.0) -> tuple[Record, np.ndarray]:
    """One trial: the record, and its torque without noise. All trials have the same input and different noise."""
    widths, names = protocol()
    clean = torque(widths, sample_rate_hz)
    each = round(sample_rate_hz / 40.0)
    noise = np.random.default_rng(seed).standard_normal(clean.size) * noise_nm
    time_s = np.arange(clean.size) / sample_rate_hz
    return Record.from_arrays(time_s, np.repeat(widths, each), clean + noise, np.repeat(names, each)), clean


def score(record: Record, clean_nm: np.ndarray, method: str, **options: Any) -> dict[str, float]:
    """Best-fit rates of one fit, %: noisy ramp, clean ramp, unseen input (clean), and the ceiling set by the noise."""
    predicted = predict(fit(record, method=method, **options), record)
    names = np.array(record.segment_names)[record.segment]
    ramp, unseen = names == "ramp", names == HELD_OUT
    return {
        "noisy": best_fit_percent(record.torque_nm[ramp], predicted[ramp]),
        "ceiling": best_fit_percent(record.torque_nm[ramp], clean_nm[ramp]),
        "clean": best_fit_percent(clean_nm[ramp], predicted[ramp]),
        "unseen": best_fit_percent(clean_nm[unseen], predicted[unseen]),
    }


def table1(
    trials: int = 100,
    progress: Callable[[float, str], Any] | None = None,
    noise_levels_nm: tuple[float, ...] = NOISE_NM,
) -> dict[str, Any]:
    """Compute the table.

    `trials`: records per noise level (without noise: one, since all would be equal). `progress`: called with the share
    done, 0 to 1, and a line of text. `noise_levels_nm`: standard deviations of the output noise, N·m, at 40 samples a
    second; the paper has 1600, with 40 pulses/s.

    Returns `rows`: one per noise level and method, with noise_nm, method, paper, paper_sd, ours, ours_sd, ceiling,
    clean, unseen (means over trials, %); and the settings.
    """
    rows: list[dict[str, Any]] = []
    total = len(noise_levels_nm) * len(OURS)
    for level in noise_levels_nm:
        count = trials if level > 0 else 1
        records = [simulate(level, FIRST_SEED + trial) for trial in range(count)]
        for method in OURS:
            scores = []
            for trial, (record, clean) in enumerate(records):
                scores.append(score(record, clean, method))
                if progress is not None:
                    progress((len(rows) + (trial + 1) / count) / total, f"{method}, noise {level:g} N·m")
            printed = method in PAPER and level in NOISE_NM
            paper, paper_sd = PAPER[method][NOISE_NM.index(level)] if printed else (None, None)
            mean = {key: float(np.mean([each[key] for each in scores])) for key in scores[0]}
            sd = float(np.std([each["noisy"] for each in scores], ddof=1)) if count > 1 else 0.0
            row = {"noise_nm": level, "method": method, "paper": paper, "paper_sd": paper_sd}
            rows.append(row | {"ours": mean.pop("noisy"), "ours_sd": sd} | mean)
    return {
        "rows": rows,
        "trials": trials,
        "sample_rate_hz": PULSE_RATE_HZ,
        "unit": "best fit, % (mean over trials); noise in N·m",
        "scored_on": "ours and ceiling: the noisy ramp; clean: the ramp without noise; unseen: multi-level, no noise",
        "explained_in": "docs/results/table1.md",
    }
