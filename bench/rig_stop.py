"""How fast a stop is: from the request on the socket to the last pulse felt, and to the confirmed answer.

    python -m bench.rig_stop [--fit] [--busy N] [--stops N]

Each stop falls at a random moment of a steady stimulation on the emulated rig, in real time.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.harness.processes import CLINIC_WATCH, Bench, busy_process, control, default_plan
from tests.harness.soak import fitting_one

STEPS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 20.0, "off_s": 0.0, "repeats": 1}},
]


def measure(busy: int, stops: int, fit: bool = False) -> tuple[list[float], list[float]]:
    """Milliseconds from request to last pulse (negative: before it) and to the answer, one each per stop."""
    last_pulse_ms, answer_ms = [], []
    with tempfile.TemporaryDirectory(prefix="rig-bench-") as folder, contextlib.ExitStack() as stack:
        bench = Bench(Path(folder))
        stack.callback(bench.close)
        client = bench.start_rig(watch=CLINIC_WATCH)
        client.ask("subscribe")
        stack.enter_context(fitting_one(bench, client, fit))
        for _ in range(busy):
            stack.enter_context(busy_process())
        for number in range(stops):
            assert client.start(default_plan(f"stop{number}", segments=STEPS))["ok"]
            client.wait_state("running")
            time.sleep(1.8 + random.random() * 0.5)  # past the rest, which the limit between two tests asks for
            asked_s = time.monotonic()
            evidence = client.ask("stop", reason="bench", by="bench")["body"]
            answer_ms.append(1e3 * (time.monotonic() - asked_s))
            assert evidence["confirmed"], evidence
            pulses = control(bench.emulator.ready["control"], {"cmd": "pulses", "since": 0})["pulses"]
            last_pulse_ms.append(1e3 * (pulses[-1]["monotonic_s"] - asked_s))
            client.wait_finished(f"stop{number}")
            client.wait_state("latched")
            assert client.rearm("bench")["ok"]
    return last_pulse_ms, answer_ms


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="fit a recording again and again in another process")
    parser.add_argument("--busy", type=int, default=0, help="CPU-bound processes beside the rig")
    parser.add_argument("--stops", type=int, default=30)
    options = parser.parse_args()
    last_pulse_ms, answer_ms = measure(options.busy, options.stops, options.fit)
    beside = f"{options.busy} busy processes" + (" and a fit" if options.fit else "")
    print(f"{beside}, {options.stops} stops (ms: median / p99 / max)")
    for name, values in (("request to last pulse", last_pulse_ms), ("request to confirmed answer", answer_ms)):
        print(f"{name}: {np.median(values):.1f} / {np.percentile(values, 99):.1f} / {max(values):.1f}")


if __name__ == "__main__":
    main()
