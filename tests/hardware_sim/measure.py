"""Measures the emulator: CPU, lost frames, and the way from a pulse to its sync bit.

`python -m tests.hardware_sim.measure [seconds] [emulator's options]`; 40 pulses/s of the emulator's time.
"""

from __future__ import annotations

import struct
import sys
import threading
import time

import can
import numpy as np
import serial

from hardware_sim.stimulators.framing import Packet
from hardware_sim.stimulators.sciencemode4 import encode
from tests.hardware_sim.bench_board import LL_CONFIG, LL_INIT, biphasic, config
from tests.hardware_sim.emulated import Emulated, emulated

LAYOUT = struct.Struct("<fHBB")


def quantiles(seconds: np.ndarray) -> str:
    median, p99, largest = 1e3 * np.percentile(seconds, [50, 99, 100])
    return f"median {median:.2f}, p99 {p99:.2f}, max {largest:.2f} ms"


def receive(bus: can.BusABC, samples: list[tuple[float, ...]], running: threading.Event) -> None:
    while running.is_set():
        message = bus.recv(0.1)
        if message is not None:
            samples.append((time.monotonic(), *LAYOUT.unpack(message.data)[1:3]))


def fire(rig: Emulated, seconds: float) -> np.ndarray:
    """Rows of (written, acknowledged), monotonic seconds."""
    period_s = 0.025 / rig.ready["speed"]
    line = serial.Serial(rig.ready["stimulator"], 3_000_000, timeout=1)
    line.write(encode(Packet(1, LL_INIT, b"\x00")))
    line.read(12)
    rows, start_s = [], time.monotonic()
    for k in range(round(seconds / period_s)):
        time.sleep(max(0.0, start_s + k * period_s - time.monotonic()))
        written_s = time.monotonic()
        line.write(encode(Packet(k % 64, LL_CONFIG, config(*biphasic(300, 20)))))
        line.read(15)
        rows.append((written_s, time.monotonic()))
    line.close()
    return np.array(rows)


def main(seconds: float, options: list[str]) -> None:
    with emulated(*options) as rig, can.Bus(**rig.ready["can"]) as bus:
        bus.recv(1.0)  # frames begin some time after the handshake
        samples: list[tuple[float, ...]] = []
        running = threading.Event()
        running.set()
        receiver = threading.Thread(target=receive, args=(bus, samples, running))
        receiver.start()
        before_s, start_s = rig.cpu_s(), time.monotonic()
        sent = fire(rig, seconds)
        share = (rig.cpu_s() - before_s) / (time.monotonic() - start_s)
        time.sleep(0.1)
        running.clear()
        receiver.join()
        pulses = rig.ask(cmd="pulses")["pulses"]
    received = np.array(samples)
    lost = int(np.sum((np.diff(received[:, 1].astype(int)) & 0xFFFF) != 1))
    arrived = np.array([pulse["monotonic_s"] for pulse in pulses])
    seen = received[received[:, 2].astype(int) & 1 == 1, 0]
    print(f"{' '.join(options) or 'defaults'}: {share:.1%} of a core, {len(received)} samples, {lost} gaps")
    print(f"  {len(sent)} pulses, {len(arrived)} received, {len(seen)} sync bits")
    print(f"  written -> received {quantiles(arrived - sent[:, 0])}")
    print(f"  written -> acknowledged {quantiles(sent[:, 1] - sent[:, 0])}")
    if len(seen) == len(sent):
        print(f"  written -> sync bit at the host {quantiles(seen - sent[:, 0])}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0, sys.argv[2:])
