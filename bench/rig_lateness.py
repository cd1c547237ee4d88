"""Figures of the rig over the wire: lateness of pulses, lost samples, CPU, alignment; idle and beside a busy process.

    python -m bench.rig_lateness [--fit] [--busy N] [--tests N] [--no-sync] [--load-cell slcan]

Plays the default test in real time (38.7 s each) on the emulated rig.
"""

from __future__ import annotations

from typing import Any

from bench.common import beside, emulated_rig, parser, table
from tests.harness.processes import CLINIC_WATCH, default_plan


def measure(busy: int, tests: int, emulator_options: list[str], fit: bool = False) -> list[dict[str, Any]]:
    """Summaries of `tests` default tests with `busy` CPU-bound processes beside them."""
    with emulated_rig(*emulator_options, busy=busy, fit=fit, watch=CLINIC_WATCH) as (_, client):
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
    made = beside(parser(__doc__))
    made.add_argument("--tests", type=int, default=1)
    made.add_argument("--no-sync", action="store_true")
    made.add_argument("--load-cell", choices=["socketcand", "slcan"], default="socketcand")
    options = made.parse_args()
    emulator = ["--load-cell", options.load_cell, *(["--no-sync"] if options.no_sync else [])]
    summaries = measure(options.busy, options.tests, emulator, options.fit)
    others = f"{options.busy} busy processes" + (" and a fit" if options.fit else "")
    print(f"{others}, {options.load_cell}, {'no ' if options.no_sync else ''}sync line")
    heads = "pulses, dropped, late median ms, p99, max, ack p99 ms, max, samples, lost, rig CPU %, alignment, error ms"
    print(*table(heads.split(", "), [figures(s) for s in summaries if s["lateness_ms"]]), sep="\n")


def figures(s: dict[str, Any]) -> list[object]:
    """A line of the table, of a test that did not end before its first pulse."""
    late, ack, alignment = s["lateness_ms"], s["ack_delay_ms"], s["alignment"]
    times_ms = [late["median"], late["p99"], late["max"], ack["p99"], ack["max"]]
    counts = [s["samples"], s["lost_samples"], f"{s['cpu_percent']:.1f}"]
    found = [s["pulses"], s["dropped_pulses"], *(f"{ms:.3f}" for ms in times_ms), *counts]
    return [*found, alignment["method"], f"{alignment['error_ms']:.3f}"]


if __name__ == "__main__":
    main()
