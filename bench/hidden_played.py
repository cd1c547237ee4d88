"""A hidden patient on the wire, through REST alone: test, compare, diagnose, next experiment, add, reveal."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from stimrig.api.cli.launcher import Services
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings

TOKEN = "token-of-the-hidden-patients"
PARTICIPANT = "HIDDEN"
NOISE_LIKE = 1.3


def reveal(seed: int, *more: str) -> dict[str, Any]:
    """What the emulator hides, asked after the verdict; `more` are the emulator's options that change it."""
    done = subprocess.run(
        [sys.executable, "-m", "stimrig.hardware_sim", "--reveal", str(seed), *more],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def play(client: Client) -> dict[str, Any]:
    """The whole path; nothing in it knows the seed."""
    client.ensure_participant(PARTICIPANT)
    test = client.run_test(PARTICIPANT)
    model, tests = test["model_id"], [test]
    found = client.diagnosis(model)
    steps = [summary(client, model)]
    first, experiment = found, None
    if found["verdict"] == "effect_missing" and found.get("experiment"):
        experiment = found["experiment"]
        plan = {"kind": "next-experiment", "segments": experiment["segments"], "joins": model}
        tests.append(client.run_test(PARTICIPANT, **plan))
        model = tests[-1]["model_id"]
        found = client.diagnosis(model)
        steps.append(summary(client, model))
    if found["verdict"] == "effect_missing":
        for entry in found["missing"]:
            model = client.add_effects(model, [entry["effect"]])["id"]
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


def summary(client: Client, model_id: str) -> dict[str, Any]:
    """A version's errors."""
    version, comparison = client.version(model_id), client.comparison(model_id)
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
    with Services(settings, options, TOKEN) as services, Client(services.url, TOKEN, timeout_s=600) as client:
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
