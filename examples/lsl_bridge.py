"""Send what the live channel shows of a participant's tests to Lab Streaming Layer, where LabRecorder finds it.

    STIMRIG_TOKEN=… python examples/lsl_bridge.py --url http://127.0.0.1:8000 --participant P017

Needs `pip install pylsl`. Three streams stay open from test to test: `stimrig-torque` (smallest and largest torque of
each bin, N·m, about 20 a second), `stimrig-pulses` (width, µs, of each pulse that was sent) and `stimrig-marks` (start,
name of each segment, end). Times are right to the delay of the network. Everyone in the local network sees the streams.
It is for watching, and for finding a test among other streams: fits and controllers read the sealed recording.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from typing import Any

import pylsl

from stimrig import Client
from stimrig.errors import ServiceError

STREAMS = {
    "torque": ("Torque", ("torque_min N·m", "torque_max N·m"), pylsl.cf_double64),
    "pulses": ("Stimulation", ("pulse_width µs",), pylsl.cf_double64),
    "marks": ("Markers", ("mark",), pylsl.cf_string),
}


def open_outlet(name: str, kind: str, channels: tuple[str, ...], format: Any) -> Any:
    info = pylsl.StreamInfo(name, kind, len(channels), pylsl.IRREGULAR_RATE, format, name)
    described = info.desc().append_child("channels")
    for text in channels:
        label, _, unit = text.partition(" ")
        described.append_child("channel").append_child_value("label", label).append_child_value("unit", unit)
    return pylsl.StreamOutlet(info)


def follow(client: Any, test_id: str, outlets: dict[str, Any]) -> None:
    """Send one test until its end."""
    zero_s, segment, earlier = math.inf, None, []
    for message in client.live(test_id):
        if message["type"] == "history":
            earlier = [message]  # its times are known with the first live message
        elif message["type"] == "live" and message["test_id"] == test_id:
            if zero_s == math.inf:
                outlets["marks"].push_sample([f"start {test_id}"], pylsl.local_clock() - message["elapsed_s"])
            zero_s = min(zero_s, pylsl.local_clock() - message["elapsed_s"])  # the message with the least delay
            for part in (*earlier, message):
                for at_s, *torque_nm in zip(part["time_s"], part["torque_min_nm"], part["torque_max_nm"], strict=True):
                    outlets["torque"].push_sample(torque_nm, zero_s + at_s)
                for at_s, width_us in zip(part["pulse_time_s"], part["pulse_width_us"], strict=True):
                    if width_us > 0:
                        outlets["pulses"].push_sample([width_us], zero_s + at_s)
            earlier = []
            if message["segment"] not in (None, segment):
                segment = message["segment"]
                outlets["marks"].push_sample([segment], zero_s + message["elapsed_s"])
    outlets["marks"].push_sample([f"end {test_id}"], pylsl.local_clock())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--participant", required=True)
    options = parser.parse_args()
    token = os.environ.get("STIMRIG_TOKEN") or sys.exit("set STIMRIG_TOKEN to a key that may read")
    streams = {part: open_outlet(f"stimrig-{part}", *described) for part, described in STREAMS.items()}
    with Client(options.url, token) as service:
        while True:
            try:
                for test in service.tests(options.participant):
                    if not test["done"]:
                        follow(service, test["id"], streams)
            except ServiceError as error:
                print(error, file=sys.stderr)
            time.sleep(0.5)
