"""How well the pulse widths found for a reference torque make a muscle follow it, open loop, in the first trial.

    python -m bench.inversion [--seeds 3 4 6 7]

The muscles are those of `tests.identify.hidden_muscles`, whose equations are not the library's, with one thing hidden
in each. A model with that effect is fitted to a record at 100 Hz and inverted; what the muscle then really does is
compared with the reference, ten seconds of moves and holds. Rivals: the same model's curve inverted alone, as if there
were no dynamics; and the model without its effects. Seed 2 was developed on. Times are ratios to one prediction.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from bench.common import parser
from examples.ilc_controller import Reference as Moves
from stimrig import identify
from stimrig.identify.inversion import Reference, invert
from stimrig.identify.model import Model
from stimrig.identify.simulation.pulses import above_rest
from tests.identify import hidden_muscles

HIDDEN = ("", "fatigue", "electromechanical_delay", "threshold_drift", "asymmetric_relaxation")
RISE_US = 50.0
REPEATS = 5


def main() -> None:
    """Print the table."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, nargs="+", default=[3, 4, 6, 7])
    seeds = made.parse_args().seeds
    print(f"median of seeds {seeds}; error of the muscle's torque in % of the reference's rms")
    print(
        f"{'hidden':26s}{'curve alone':>12s}{'no effects':>12s}{'ours':>8s}{'foretold':>10s}{'times a prediction':>20s}"
    )
    for hidden in HIDDEN:
        found = np.median([one(hidden, seed) for seed in seeds], axis=0)
        print(
            f"{hidden or 'nothing':26s}{found[0]:12.2f}{found[1]:12.2f}{found[2]:8.2f}{found[3]:10.2f}{found[4]:20.1f}"
        )


def one(hidden: str, seed: int) -> list[float]:
    """Errors of the three, the foretold one of ours, and its time as a multiple of a prediction's."""
    model = identify.fit(hidden_muscles.record(hidden, seed=seed, rate_hz=100), effects=(hidden,) if hidden else ())
    wanted = Moves.reach(0.6 * model.figures()["plateau_nm"]["value"]).torque_nm
    reference = Reference.of(wanted)

    def error(torque_nm: np.ndarray) -> float:
        return float(100.0 * np.linalg.norm(torque_nm - wanted) / np.linalg.norm(wanted))

    def really(widths_us: np.ndarray) -> float:
        return error(hidden_muscles.muscle(widths_us, hidden).reshape(-1, 25).mean(axis=1))

    found = invert(model, reference, rise_us=RISE_US)
    plain = invert(model.with_(effects=()), reference, rise_us=RISE_US)
    ours_s = seconds(lambda: invert(model, reference, rise_us=RISE_US))
    prediction_s = seconds(lambda: above_rest(model, found.pulse_width_us, 40.0))
    ratio = ours_s / prediction_s
    return [
        really(static(model, wanted)), really(plain.pulse_width_us), really(found.pulse_width_us),
        error(found.predicted_nm), ratio,
    ]  # fmt: skip


def static(model: Model, wanted_nm: np.ndarray) -> np.ndarray:
    """f⁻¹ of the reference itself, whole µs."""
    level_nm, width_us = model.recruitment.inverse()
    return np.round(np.interp(wanted_nm, level_nm, width_us))


def seconds(work: Callable[[], object]) -> float:
    """Of the quickest of some runs."""
    work()
    took = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        work()
        took.append(time.perf_counter() - begun)
    return min(took)


if __name__ == "__main__":
    main()
