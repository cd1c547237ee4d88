"""Figures of the rig over the wire: lateness of pulses, lost samples, CPU, alignment; idle and beside a busy process.

    python -m bench.rig_lateness [--fit] [--busy N] [--tests N] [--no-sync] [--load-cell slcan] [--json]

Plays the default test in real time (38.7 s each) on the emulated rig.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from pathlib import Path
from typing import Any

from tests.harness.processes import CLINIC_WATCH, Bench, busy_process, default_plan
from tests.harness.soak import fitting_one


def measure(busy: int, tests: int, emulator_options: list[str], fit: bool = False) -> list[dict[str, Any]]:
    """Summaries of `tests` default tests with `busy` CPU-bound processes beside them."""
    with tempfile.TemporaryDirectory(prefix="rig-bench-") as folder, contextlib.ExitStack() as stack:
        bench = Bench(Path(folder), *emulator_options)
        stack.callback(bench.close)
        client = bench.start_rig(watch=CLINIC_WATCH)
        client.ask("subscribe")
        stack.enter_context(fitting_one(bench, client, fit))
        for _ in range(busy):
            stack.enter_context(busy_process())
        events = []
        for number in range(tests):
            reply = client.start(default_plan(f"bench{number}"))
            if not reply["ok"]:
                raise SystemExit(reply["problem"]["detail"])
            events.append(client.wait_finished(f"bench{number}"))
            if events[-1]["outcome"] != "completed":
                print(f"test {number} ended: {events[-1]['reason']}")
                client.rearm("bench")
        return [event["summary"] for event in events]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="fit a recording again and again in another process")
    parser.add_argument("--busy", type=int, default=0, help="CPU-bound processes beside the rig")
    parser.add_argument("--tests", type=int, default=1)
    parser.add_argument("--no-sync", action="store_true")
    parser.add_argument("--load-cell", choices=["socketcand", "slcan"], default="socketcand")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    emulator = ["--load-cell", options.load_cell, *(["--no-sync"] if options.no_sync else [])]
    summaries = measure(options.busy, options.tests, emulator, options.fit)
    if options.json:
        print(json.dumps(summaries))
        return
    beside = f"{options.busy} busy processes" + (" and a fit" if options.fit else "")
    print(f"{beside}, {options.load_cell}, {'no ' if options.no_sync else ''}sync line")
    print(
        "| pulses | dropped | late median ms | p99 | max | ack p99 ms | max | samples | lost | rig CPU % | alignment "
        "| error ms |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for s in summaries:
        if not s["lateness_ms"]:
            continue  # ended before its first pulse; said above
        late, ack, alignment = s["lateness_ms"], s["ack_delay_ms"], s["alignment"]
        print(
            f"| {s['pulses']} | {s['dropped_pulses']} | {late['median']:.3f} | {late['p99']:.3f} | {late['max']:.3f} "
            f"| {ack['p99']:.3f} | {ack['max']:.3f} | {s['samples']} | {s['lost_samples']} | {s['cpu_percent']:.1f} "
            f"| {alignment['method']} | {alignment['error_ms']:.3f} |"
        )


if __name__ == "__main__":
    main()
