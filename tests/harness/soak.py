"""A long session: torque at 1600 samples/s throughout, a test every few minutes, fits in another process all the time.

Real time, on the emulated rig. Counts lost samples, lateness of pulses, CPU and memory.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from tests.harness.processes import CLINIC_WATCH, ROOT, Bench, default_plan

FITTER = """
import sys, time
from pathlib import Path
from stimrig.identify.fitting import fit
from stimrig.identify import read
fits = 0
while True:
    newest = sorted(Path(sys.argv[1]).glob('*.h5'))[-1:]
    if not newest:
        sum(range(10000))  # before the first recording: busy all the same
        continue
    fit(read(newest[0]))
    fits += 1
    print(fits, flush=True)
"""
"""Fits the newest recording again and again."""


@contextlib.contextmanager
def fitting(recordings: Path, log: Path) -> Iterator[None]:
    """A process that fits without a pause; it writes a line for each fit."""
    command = [sys.executable, "-c", FITTER, str(recordings)]
    with log.open("w") as out:
        process = subprocess.Popen(command, cwd=ROOT, stdout=out)
    try:
        yield
        if process.poll() is not None:
            print("the fitting process ended early", file=sys.stderr)
    finally:
        process.kill()
        process.wait()


def soak(minutes: float, every_minutes: float, fit: bool = True, patient: bool = False, **plan: Any) -> dict[str, Any]:
    """Run a session and give its figures.

    `patient`: with a rig that does not end a test for a torque 0.1 s old. `plan`: fields of the tests' plan.
    """
    with tempfile.TemporaryDirectory(prefix="rig-soak-") as folder:
        bench, log = Bench(Path(folder)), Path(folder) / "fits.log"
        log.touch()
        try:
            client = bench.start_rig(watch=None if patient else CLINIC_WATCH)
            client.ask("subscribe")
            with fitting(bench.data / "recordings", log) if fit else contextlib.nullcontext():
                figures = _session(bench, client, minutes, every_minutes, plan)
            return figures | {"fits_beside": len(log.read_text().splitlines())}
        finally:
            bench.close()


def _session(bench: Bench, client: Any, minutes: float, every_minutes: float, plan: dict[str, Any]) -> dict[str, Any]:
    assert bench.rig is not None
    rig, began_s = psutil.Process(bench.rig.popen.pid), time.monotonic()
    memory_mb, tests, oldest_ms = [rig.memory_info().rss / 2**20], [], 0.0
    load = os.getloadavg()[0]
    while time.monotonic() - began_s < 60 * minutes:
        next_s = time.monotonic() + 60 * every_minutes
        name = f"soak{len(tests)}"
        reply = client.start(default_plan(name, **plan))
        if not reply["ok"]:
            tests.append({"outcome": "refused", "reason": reply["problem"]["detail"], "summary": {}})
            client.rearm("soak")
        else:
            tests.append(client.wait_finished(name, timeout_s=120))
            if tests[-1]["outcome"] != "completed":
                client.rearm("soak")
        memory_mb.append(rig.memory_info().rss / 2**20)
        while time.monotonic() < min(next_s, began_s + 60 * minutes):
            while not client.events.empty():
                event = client.events.get_nowait()
                if event["event"] == "live":
                    oldest_ms = max(oldest_ms, 1e3 * event["torque_age_s"])
            time.sleep(0.5)
    status = client.status()
    return _figures(tests, len(bench.felt())) | {
        "minutes": round((time.monotonic() - began_s) / 60, 2),
        "load_average": [round(load, 1), round(os.getloadavg()[0], 1)],
        "memory_mb": [round(memory_mb[0], 1), round(memory_mb[-1], 1)],
        "oldest_torque_ms": round(oldest_ms, 1),
        "measured_rate_hz": status["load_cell"].get("measured_rate_hz"),
        "state": status["state"],
    }


def _figures(tests: list[dict[str, Any]], felt: int) -> dict[str, Any]:
    done = [t["summary"] for t in tests if t["outcome"] == "completed"]

    def worst(name: str) -> float | None:
        return round(max((t["lateness_ms"][name] for t in done), default=float("nan")), 3)

    return {
        "tests": len(tests),
        "completed": len(done),
        "reasons": [t["reason"] for t in tests if t["outcome"] != "completed"],
        "samples": sum(t["samples"] for t in done),
        "lost_samples": sum(t["lost_samples"] for t in done),
        "pulses_felt": felt,
        "pulses_sent": sum(t["summary"].get("pulses", 0) for t in tests),
        "dropped_pulses": sum(t["dropped_pulses"] for t in done),
        "lateness_ms": {name: worst(name) for name in ("median", "p99", "max")},
        "alignment_error_ms": round(max((t["alignment"]["error_ms"] for t in done), default=float("nan")), 3),
        "cpu_percent": round(float(np.mean([t["cpu_percent"] for t in done])) if done else float("nan"), 1),
    }
