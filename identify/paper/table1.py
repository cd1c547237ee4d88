"""Table I of the paper: best-fit rates of its three methods at six noise levels, as printed and as computed here.

In addition to the fit on the noisy ramp: the best fit that the noise allows, the fit to the torque of the ramp without
noise, and the fit on a multi-level input that was not fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.fitting import fit
from stimrig.identify.paper import muscle
from stimrig.identify.records.record import Record
from stimrig.identify.simulation.predict import predict

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
    widths, names = muscle.protocol()
    clean = muscle.torque(widths, sample_rate_hz)
    each = round(sample_rate_hz / 40.0)
    noise = np.random.default_rng(seed).standard_normal(clean.size) * noise_nm
    time_s = np.arange(clean.size) / sample_rate_hz
    return Record.from_arrays(time_s, np.repeat(widths, each), clean + noise, np.repeat(names, each)), clean


def score(record: Record, clean_nm: np.ndarray, method: str, **options: Any) -> dict[str, float]:
    """Best-fit rates of one fit, %: noisy ramp, clean ramp, unseen input (clean), and the ceiling set by the noise."""
    predicted = predict(fit(record, method=method, **options), record)
    names = np.array(record.segment_names)[record.segment]
    ramp, unseen = names == "ramp", names == "validate"
    return {
        "noisy": best_fit_percent(record.torque_nm[ramp], predicted[ramp]),
        "ceiling": best_fit_percent(record.torque_nm[ramp], clean_nm[ramp]),
        "clean": best_fit_percent(clean_nm[ramp], predicted[ramp]),
        "unseen": best_fit_percent(clean_nm[unseen], predicted[unseen]),
    }


def run(
    trials: int = 100,
    progress: Callable[[float, str], Any] | None = None,
    sample_rate_hz: float = 40.0,
    noise_levels_nm: tuple[float, ...] = NOISE_NM,
) -> dict[str, Any]:
    """Compute the table.

    Parameters
    ----------
    trials : int
        Records per noise level (without noise: one, since all would be equal).
    progress : callable, optional
        Called with the share done, 0 to 1, and a line of text.
    sample_rate_hz : float
        Sampling rate, Hz; the paper uses 1600 Hz, with 40 pulses/s.
    noise_levels_nm : tuple of float
        Standard deviations of the output noise, N·m.

    Returns
    -------
    dict
        `rows`: one per noise level and method, with noise_nm, method, paper, paper_sd, ours, ours_sd, ceiling, clean,
        unseen (means over trials, %); and the settings.
    """
    rows: list[dict[str, Any]] = []
    total, done = len(noise_levels_nm) * len(OURS), 0
    for level in noise_levels_nm:
        count = trials if level > 0 else 1
        records = [simulate(level, FIRST_SEED + trial, sample_rate_hz) for trial in range(count)]
        for method in OURS:
            scores = []
            for trial, (record, clean) in enumerate(records):
                scores.append(score(record, clean, method))
                if progress is not None:
                    progress((done + (trial + 1) / count) / total, f"{method}, noise {level:g} N·m")
            done += 1
            rows.append(_row(level, method, scores))
    return {
        "rows": rows,
        "trials": trials,
        "sample_rate_hz": sample_rate_hz,
        "unit": "best fit, % (mean over trials); noise in N·m",
        "scored_on": "ours and ceiling: the noisy ramp; clean: the ramp without noise; unseen: multi-level, no noise",
        "explained_in": "docs/results/table1.md",
    }


def _row(level: float, method: str, scores: list[dict[str, float]]) -> dict[str, Any]:
    printed = PAPER.get(method, ())[NOISE_NM.index(level)] if method in PAPER and level in NOISE_NM else (None, None)
    mean = {key: float(np.mean([s[key] for s in scores])) for key in scores[0]}
    return {
        "noise_nm": level,
        "method": method,
        "paper": printed[0],
        "paper_sd": printed[1],
        "ours": mean["noisy"],
        "ours_sd": float(np.std([s["noisy"] for s in scores], ddof=1)) if len(scores) > 1 else 0.0,
        "ceiling": mean["ceiling"],
        "clean": mean["clean"],
        "unseen": mean["unseen"],
    }
