"""What a frame of an slcan adapter costs the reader, with what waits taken at once and byte by byte.

    python -m bench.slcan_reading [--frames N] [--rounds N]

Both in turn in the same run, over a pseudo-terminal that is always full.
"""

from __future__ import annotations

import argparse
import os
import pty
import statistics
import struct
import threading
import time
import tty

from rig.adapters.machine import LocalMachine
from rig.adapters.read_ahead import ReadAhead
from rig.clock import MonotonicClock
from rig.devices.can_load_cell import CanLoadCell, Settings
from rig.signals import TorqueBlock


def measure(frames: int, ahead: bool) -> tuple[float, float]:
    """Frames per second, and microseconds of processor per frame (the feeding thread's included)."""
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    bus = {"interface": "slcan", "channel": os.ttyname(theirs)}
    machine = LocalMachine(MonotonicClock())
    cell = CanLoadCell(Settings(device="can_load_cell", bus=bus), machine)
    got, all_came = 0, threading.Event()

    def take(block: TorqueBlock) -> None:
        nonlocal got
        got += len(block)
        if got >= frames:
            all_came.set()

    machine.driver.ask(lambda: cell.open(take, print)).result()
    os.read(ours, 1000)
    if not ahead and isinstance(cell._bus.can.serialPortOrig, ReadAhead):  # pyright: ignore
        cell._bus.can.serialPortOrig = cell._bus.can.serialPortOrig._port  # pyright: ignore
    lines = b"".join(
        b"t1818" + struct.pack("<fHBB", 1.0, i & 0xFFFF, 0, 0).hex().encode() + b"\r" for i in range(frames)
    )

    def feed() -> None:
        given = 0
        while given < len(lines):
            given += os.write(ours, lines[given : given + 2000])

    feeder = threading.Thread(target=feed, daemon=True)
    began_s, processor_s = time.monotonic(), time.process_time()
    feeder.start()
    all_came.wait()
    rate_hz = frames / (time.monotonic() - began_s)
    cost_us = 1e6 * (time.process_time() - processor_s) / frames
    feeder.join()
    machine.driver.ask(cell.close).result()
    machine.driver.end()
    os.close(ours)
    os.close(theirs)
    return rate_hz, cost_us


def main() -> None:
    """Print both, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    found = {ahead: [measure(options.frames, ahead) for _ in range(options.rounds)] for ahead in (False, True)}
    cost_us = {}
    for ahead, rounds in found.items():
        rate_hz, cost_us[ahead] = (statistics.median(values) for values in zip(*rounds, strict=True))
        print(f"{'at once' if ahead else 'byte by byte':14} {rate_hz:8.0f} frames/s {cost_us[ahead]:7.1f} µs/frame")
    print(f"ratio of the costs {cost_us[False] / cost_us[True]:.1f}, medians of {options.rounds} rounds")


if __name__ == "__main__":
    main()
