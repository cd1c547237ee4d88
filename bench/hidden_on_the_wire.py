"""A hidden patient on the wire, through REST alone: test, compare, diagnose, next experiment, add, and what was hidden.

    python -m bench.hidden_on_the_wire --seeds 1000:1008

Seeds are taken as they come; `--speed` lets emulator and rig run faster than the world (a busy machine makes it noisy).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import httpx

from api.cli.errors import ReportedError
from api.cli.launcher import Services
from api.cli.rest_session import checked, ensure_participant, run_test
from api.settings import Settings

TOKEN = "token-of-the-hidden-patients"
PARTICIPANT = "HIDDEN"
NOISE_LIKE = 1.3


def reveal(seed: int) -> dict[str, Any]:
    """What the emulator hides, asked after the verdict."""
    done = subprocess.run(
        [sys.executable, "-m", "hardware_sim", "--reveal", str(seed)], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def play(client: httpx.Client) -> dict[str, Any]:
    """The whole path; nothing in it knows the seed."""
    ensure_participant(client, PARTICIPANT)
    test = run_test(client, PARTICIPANT)
    model, tests = test["model_id"], [test]
    found = checked(client.get(f"/v1/models/{model}/diagnosis")).json()
    steps = [summary(client, model)]
    first, experiment = found, None
    if found["verdict"] == "effect_missing" and found.get("experiment"):
        experiment = found["experiment"]
        body = {"kind": "next-experiment", "segments": experiment["segments"], "joins": model}
        tests.append(run_test(client, PARTICIPANT, **body))
        model = tests[-1]["model_id"]
        found = checked(client.get(f"/v1/models/{model}/diagnosis")).json()
        steps.append(summary(client, model))
    if found["verdict"] == "effect_missing":
        for entry in found["missing"]:
            made = client.post(f"/v1/models/{model}/effects", json={"effects": [entry["effect"]]})
            model = checked(made).json()["id"]
            steps.append(summary(client, model))
    return {
        "verdict": found["verdict"],
        "named": [entry["effect"] for entry in found["missing"]],
        "confused_with": [rival for entry in found["missing"] for rival in entry["confused_with"]],
        "verdict_before_experiment": first["verdict"],
        "named_before_experiment": [entry["effect"] for entry in first["missing"]],
        "experiment": experiment and experiment["text"],
        "steps": steps,
        **punctuality([each["summary"] for each in tests]),
    }


def punctuality(summaries: list[dict[str, Any]]) -> dict[str, Any]:
    """How late pulses were in the worst of the tests, and how many were dropped in all."""
    late = [each["lateness_ms"] for each in summaries]
    return {
        "lateness_ms": {key: max(each[key] for each in late) for key in ("median", "p99", "max")},
        "dropped_pulses": sum(each["dropped_pulses"] for each in summaries),
    }


def summary(client: httpx.Client, model_id: str) -> dict[str, Any]:
    """A version's errors."""
    version = checked(client.get(f"/v1/models/{model_id}")).json()
    comparison = checked(client.get(f"/v1/models/{model_id}/comparison")).json()
    held = comparison.get("held_out") or comparison
    return {
        "effects": version["effects"],
        "held_out_rms_nm": held["rms_nm"],
        "noise_sd_nm": comparison["noise_sd_nm"],
        "times_noise": held["rms_nm"] / comparison["noise_sd_nm"],
    }


def agrees(found: dict[str, Any], truth: dict[str, Any]) -> bool:
    """Whether the verdict is what was hidden: one effect named first, two both named; nothing; or no name for it."""
    if truth["outside_library"]:
        return found["verdict"] == "unexplained_structure"
    if not truth["effects"]:
        return found["verdict"] == "nothing_missing"
    first = found["named"][: len(truth["effects"])]
    return found["verdict"] == "effect_missing" and set(truth["effects"]) == set(first)


def run(seed: int, speed: float, folder: Path) -> dict[str, Any]:
    """One seed on services of its own."""
    settings = Settings(data_dir=folder, port=0)
    options = ["--hidden", str(seed), "--speed", str(speed), "--noise-seed", str(seed)]
    with Services(settings, options, TOKEN) as services:
        headers = {"Authorization": f"Bearer {TOKEN}"}
        with httpx.Client(base_url=services.url, headers=headers, timeout=600) as client:
            found = play(client)
    truth = reveal(seed)
    last = found["steps"][-1]["times_noise"]
    return {
        "seed": seed,
        "hidden": truth["effects"],
        "strength": truth["strength"],
        "outside_library": truth["outside_library"],
        **found,
        "agrees": agrees(found, truth),
        "noise_like": last <= NOISE_LIKE,
        "times_noise": [round(step["times_noise"], 2) for step in found["steps"]],
    }


def main() -> None:
    """Print one line a seed, and how many agree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1000:1008", help="first:last, last not included")
    parser.add_argument("--speed", type=float, default=2.0)
    parser.add_argument("--json", type=Path, help="write all that was found here")
    options = parser.parse_args()
    first, _, last = options.seeds.partition(":")
    rows = []
    for seed in range(int(first), int(last or int(first) + 1)):
        try:
            with tempfile.TemporaryDirectory(prefix="hidden-") as folder:
                row = run(seed, options.speed, Path(folder))
        except (ReportedError, httpx.HTTPError) as error:
            rows.append({"seed": seed, "agrees": False, "error": str(error)})
            print(f"{seed}  FAILED: {error}", flush=True)
            continue
        rows.append(row)
        hidden = "+".join(row["hidden"]) or "nothing"
        print(
            f"{seed}  hidden {hidden} ({row['strength']}{', outside' if row['outside_library'] else ''})  "
            f"verdict {row['verdict']}: {', '.join(row['named']) or '-'}  before the experiment "
            f"{', '.join(row['named_before_experiment']) or '-'}  error/noise {row['times_noise']}  "
            f"pulses late {row['lateness_ms']} ms, {row['dropped_pulses']} dropped  "
            f"{'agrees' if row['agrees'] else 'DIFFERS'}",
            flush=True,
        )
    print(f"{sum(row['agrees'] for row in rows)} of {len(rows)} agree")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
