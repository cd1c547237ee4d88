"""How fast a stop is: from the request on the socket to the last pulse felt, and to the confirmed answer.

    python -m bench.rig_stop [--fit] [--busy N] [--stops N]

Each stop falls at a random moment of a steady stimulation on the emulated rig, in real time.
"""

from __future__ import annotations

import random
import time

from bench.common import beside, emulated_rig, parser, spread
from tests.harness.processes import CLINIC_WATCH, control, default_plan

STEPS = [
    {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}},
    {"name": "hold", "sequence": "steps", "settings": {"on_s": 20.0, "off_s": 0.0, "repeats": 1}},
]


def measure(busy: int, stops: int, fit: bool = False) -> tuple[list[float], list[float]]:
    """Milliseconds from request to last pulse (negative: before it) and to the answer, one each per stop."""
    last_pulse_ms, answer_ms = [], []
    with emulated_rig(busy=busy, fit=fit, watch=CLINIC_WATCH) as (bench, client):
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
    made = beside(parser(__doc__))
    made.add_argument("--stops", type=int, default=30)
    options = made.parse_args()
    last_pulse_ms, answer_ms = measure(options.busy, options.stops, options.fit)
    others = f"{options.busy} busy processes" + (" and a fit" if options.fit else "")
    print(f"{others}, {options.stops} stops (ms: median / p99 / max)")
    for name, values in (("request to last pulse", last_pulse_ms), ("request to confirmed answer", answer_ms)):
        print(f"{name}: {' / '.join(f'{value:.1f}' for value in spread(values, 1.0).values())}")


if __name__ == "__main__":
    main()
