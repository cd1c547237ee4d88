"""Adaptive tests on the emulated rig in real time, through the service, against the paper's test on the same patient.

    python -m bench.adaptive_on_rig --patients 20 --seeds 84000 [--json FILE]

Each patient has a sigmoid as its recruitment curve (`tests.harness.adaptive.sigmoid`, without a delay) and noise of
0.05 N·m. The adaptive test comes first, the paper's test after it; both are identified by the service. "Unseen" is the
best fit of the model's prediction to the clean torque of random levels. "Sample to plan": from the arrival of the
newest sample that the decision knows to the rig's word that its piece is laid.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.adaptive import unseen_percent
from bench.common import keep_lines, parser, services, table
from stimrig.api.client.documents import SessionTest
from stimrig.api.client.errors import NotCompleted
from stimrig.api.client.rest import Client
from stimrig.identify.model import Model
from stimrig.identify.records.recording import read_recording
from tests.harness.adaptive import Muscle, sigmoid, sigmoid_of

PERSON = "BENCH"


def patient_file(seed: int, path: Path) -> Muscle:
    """The emulator's file of that patient; and the same muscle, for the figures."""
    muscle = replace(sigmoid(seed), delay_s=0.0)
    curve = sigmoid_of(seed)
    rows = {"a1": curve.gain, "a2": curve.a2, "a3": curve.a3}
    rows |= {"natural_period_s": muscle.time_constant_s, "damping_ratio": muscle.damping}
    path.write_text(
        'patient = "paper"\n[parameters]\n' + "".join(f"{key} = {value!r}\n" for key, value in rows.items())
    )
    return muscle


def told_of(client: Client, muscle: Muscle, seed: int, test: SessionTest) -> dict[str, Any]:
    """What a test took, and how well its model foretells."""
    model = Model.from_json(json.dumps(client.model_file(test["model_id"])))
    pulses = read_recording(client.recording(test["recording_id"]), Path("recording.h5")).pulses
    assert pulses is not None
    return {
        "seconds": test["summary"]["duration_s"],
        "dropped": test["summary"]["dropped_pulses"],
        "dose": float(np.sum(muscle.curve(pulses.width_us))) / 40.0,
        "unseen": unseen_percent(muscle, model.predict, seed),
    }


def one(seed: int, folder: Path) -> dict[str, Any]:
    """Both tests of one patient."""
    muscle = patient_file(seed, folder / "patient.toml")
    emulator = ["--patient", str(folder / "patient.toml"), "--noise-seed", str(seed)]
    with services(*emulator) as (_, client):
        client.ensure_participant(PERSON)
        ours = client.run_test(PERSON, kind="adaptive")
        told = ours["adaptive"]
        paper = client.run_test(PERSON)
        return {
            "seed": seed,
            "ended": told["ended"],
            "problem": told["problem"],
            "refused": [row["refused"] for row in told["decisions"] if "refused" in row],
            "decisions": told["decisions"],
            "sample_to_plan_ms": [row["sample_to_plan_ms"] for row in told["decisions"] if "sample_to_plan_ms" in row],
            "ours": told_of(client, muscle, seed, ours),
            "paper": told_of(client, muscle, seed, paper),
        }


def medians(rows: list[dict[str, Any]]) -> list[str]:
    """Medians, as lines."""
    cells = []
    for test in ("ours", "paper"):
        mid = {key: float(np.median([row[test][key] for row in rows])) for key in ("seconds", "dose", "unseen")}
        dropped = sum(row[test]["dropped"] for row in rows)
        figures = [f"{mid['seconds']:.1f}", f"{mid['dose']:.1f}", f"{mid['unseen']:.2f}"]
        cells.append([test, len(rows), *figures, dropped])
    share = {
        key: 100.0 * float(np.median([row["ours"][key] / row["paper"][key] for row in rows]))
        for key in ("seconds", "dose")
    }
    worse = float(np.median([row["ours"]["unseen"] - row["paper"]["unseen"] for row in rows]))
    plan_ms = np.concatenate([row["sample_to_plan_ms"] for row in rows])
    half, most = np.quantile(plan_ms, [0.5, 0.99]) if plan_ms.size else (np.nan, np.nan)
    refused = sum(len(row["refused"]) for row in rows)
    ends = Counter(row["ended"] for row in rows)
    return [
        *table(["test", "n", "time, s", "dose, N·m·s", "unseen, %", "dropped pulses"], cells),
        f"Of the same patient's paper's test, median: time {share['seconds']:.0f} %, dose {share['dose']:.0f} %, "
        f"unseen {worse:+.2f} points.",
        f"Ended: {', '.join(f'{end} {count}' for end, count in ends.items())}. "
        f"Not laid: {refused} of {plan_ms.size + refused}.",
        f"Sample to plan: {half:.0f} ms in the middle, p99 {most:.0f} ms, n = {plan_ms.size}.",
    ]


def main() -> None:
    """Print the table."""
    made = parser(__doc__)
    made.add_argument("--patients", type=int, default=20)
    made.add_argument("--seeds", type=int, default=84_000, help="the first")
    made.add_argument("--json", type=Path, help="every row goes here, one a line")
    settings = made.parse_args()
    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    for seed in range(settings.seeds, settings.seeds + settings.patients):
        with tempfile.TemporaryDirectory(prefix="adaptive-") as folder:
            try:
                rows.append(one(seed, Path(folder)))
            except NotCompleted as error:  # the machine stood still, and the rig stopped
                failed.append(f"{seed}: {error}")
                print(failed[-1], file=sys.stderr, flush=True)
                continue
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        keep_lines(settings.json, rows)
    print(*(medians(rows) if rows else []), *failed, sep="\n")


if __name__ == "__main__":
    main()
