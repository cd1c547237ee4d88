"""Torque as it is measured: start a trial, and print what the live channel sends until its end.

    STIMRIG_TOKEN=… python examples/live_torque.py --url http://127.0.0.1:8000 --participant P017

The channel sends about 20 messages a second. It is for watching, not for closing a loop: what a pulse does is seen some
hundredths of a second later, by way of a network. Control goes from trial to trial.

If the program ends while the trial that it started plays, by Ctrl-C or by an error, it presses stop first.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

from stimrig import Client
from stimrig.errors import ServiceError


def torque(client: Client, test_id: str) -> Iterator[tuple[float, float, float]]:
    """Time in the test, s, and the smallest and largest torque since the last one, N·m, bin by bin."""
    for message in client.live(test_id):
        if message["type"] in ("history", "live"):
            rows = zip(message["time_s"], message["torque_min_nm"], message["torque_max_nm"], strict=True)
            yield from (row for row in rows if None not in row)
        elif message["type"] == "test" and message["test"]["done"]:
            print(f"ended as {message['test']['state']}: {message['test']['reason']}", file=sys.stderr)


def trial() -> list[dict[str, Any]]:
    """One second of rest, a ramp of two seconds up to 150 µs, one second of rest."""
    widths_us = [float(2 * pulse) for pulse in range(76)]
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": 1.0}}
    return [rest, {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": widths_us}}, rest]


def press_stop(client: Client) -> None:
    """Stop the rig, and say whether it has stopped."""
    try:
        client.stop("the watching program ended")
        print("stop was pressed; a person re-arms the rig", file=sys.stderr)
    except ServiceError as error:
        print(f"STOP WAS NOT CONFIRMED: use the emergency switch on the stimulator now. {error}", file=sys.stderr)


def start(client: Client, participant: str) -> str:
    """Start the trial at the pulse rate of the approved model; the test's id."""
    rate_hz = client.approved_model(participant).document["pulse_rate_hz"]
    try:
        return client.start_test(participant, kind="sequence", segments=trial(), pulse_rate_hz=rate_hz)["id"]
    except (ServiceError, KeyboardInterrupt) as error:
        if getattr(error, "status", None) is None:  # no answer came: it may play all the same
            press_stop(client)
        raise


def watch(client: Client, test_id: str) -> None:
    """Print time and torque until the test ends."""
    print("time_s,torque_min_nm,torque_max_nm", flush=True)
    for time_s, low_nm, high_nm in torque(client, test_id):
        print(f"{time_s:.4f},{low_nm:.4f},{high_nm:.4f}", flush=True)


def main() -> None:
    """Play one trial and print time and torque."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--participant", required=True)
    parser.add_argument("--test", help="watch this test instead of starting one")
    options = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background job ignores Ctrl-C unless it says so
        signal.signal(number, signal.default_int_handler)
    token = os.environ.get("STIMRIG_TOKEN") or sys.exit("set STIMRIG_TOKEN to a controller's key")
    with Client(options.url, token) as client:
        if options.test:
            watch(client, options.test)
            return
        test_id = start(client, options.participant)
        try:
            watch(client, test_id)
        except BaseException:
            press_stop(client)
            raise


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted")
    except ServiceError as error:
        sys.exit(str(error))
