"""What is answered of some records, in this process or in one with another processor's arithmetic.

python -m tests.harness.answers    prints it as JSON
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from bench.muscles.bout_records import record_of_bouts
from stimrig.identify import Record, improve
from stimrig.identify.diagnosis import side_by_side
from stimrig.identify.estimation.plain import fit_plain
from stimrig.identify.estimation.samples import fitted_rows, prepare
from tests.harness import few_effects
from tests.harness.carried_sessions import as_record
from tests.identify import hidden_muscles

OTHER_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NUMBA_CPU_NAME": "haswell",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
"""By which the libraries compute as on a processor without AVX-512."""
EFFECTS = ("baseline_drift", "fatigue", "mixed_fibres")
IMPROVED = ("fatigue", "arm 4")


@cache
def records() -> dict[str, Record]:
    """Muscles of the library's kinds, arms, arms that never rest, and arms that hardly pull."""
    made = {name or "plain": hidden_muscles.record(name, seed=15, rate_hz=100) for name in ("", "fatigue")}
    for seed in (4, 8):
        arm = record_of_bouts(seed)
        made[f"arm {seed}"] = as_record(arm)
        low_us = 0.15 * np.max(arm["pulse_width_us"])
        made[f"arm {seed} without rest"] = as_record(
            arm | {"pulse_width_us": np.maximum(arm["pulse_width_us"], low_us)}
        )
        made[f"weak arm {seed}"] = as_record(arm | {"torque_nm": arm["torque_nm"] - 0.8 * arm["clean_nm"]})
    return made


def answers(factor: float = 1.0) -> dict[str, dict[str, Any]]:
    """By record, its torque times a factor: the plain fit on its own rows, N·m, what it leaves, and added effects."""
    with patch.object(side_by_side, "WORKERS", 1):
        return {
            name: _answer(record.with_torque(factor * record.torque_nm), name) for name, record in records().items()
        }


def _answer(record: Record, name: str) -> dict[str, Any]:
    grid, _ = prepare(record)
    fitted = fit_plain(grid, fitted_rows(grid, None))
    setup = fitted.problem.setup
    own_nm = setup.to_record(fitted.problem.run(fitted.theta)[0])[setup.fitted]
    answer: dict[str, Any] = {"own_nm": own_nm.tolist(), "left_nm": fitted.rms_nm}
    if name in IMPROVED:
        with few_effects.only(*EFFECTS):
            answer["added"] = [step["added"] for step in improve(record, max_effects=1).steps]
    return answer


def answers_elsewhere() -> dict[str, dict[str, Any]]:
    """The same by a process of its own, with another processor's arithmetic."""
    command = [sys.executable, "-m", "tests.harness.answers"]
    environment = os.environ | OTHER_PROCESSOR
    root = Path(__file__).parents[2]
    done = subprocess.run(command, env=environment, cwd=root, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


if __name__ == "__main__":
    print(json.dumps(answers()))
