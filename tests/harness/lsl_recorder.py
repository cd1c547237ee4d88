"""Records the streams of `stimrig.rig.lsl_outlets` as LabRecorder does, and compares them with a sealed recording.

    python -m tests.harness.lsl_recorder NAME FILE.npz [modest]

It prints one JSON line when all streams are open, records until SIGTERM, and writes times (s, this machine's LSL clock:
the clock offsets that LSL measures are added) and values. A process of its own, so that LSL's settings are its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.harness.processes import Bench, Process

STREAMS = ("torque", "pulses", "tests")
SCOPE = "[multicast]\nResolveScope = machine\n[log]\nlevel = -2\n"
"""LSL's settings: nothing leaves the machine."""


@contextlib.contextmanager
def on_this_machine(folder: Path) -> Iterator[None]:
    """Children that are started within keep LSL on this machine."""
    place = folder / "lsl_api.cfg"
    place.write_text(SCOPE)
    before = os.environ.get("LSLAPICFG")
    os.environ["LSLAPICFG"] = str(place)
    try:
        yield
    finally:
        del os.environ["LSLAPICFG"]
        if before is not None:
            os.environ["LSLAPICFG"] = before


class Recorder:
    """The recording process."""

    def __init__(self, name: str, folder: Path, modest: bool = False) -> None:
        self._file = folder / f"{name}.npz"
        arguments = (name, str(self._file), *(["modest"] if modest else []))
        self.process = Process("tests.harness.lsl_recorder", *arguments, log=folder / f"{name}-recorder.log")
        self.info: dict[str, str] = self.process.ready["info"]

    def end(self) -> dict[str, Any]:
        """What it recorded."""
        assert self.process.stop() == 0, self.process.log.read_text()
        with np.load(self._file) as found:
            return dict(found)


class Streams:
    """Outlets on a rig's data folder, and a recorder that was there from the beginning; both end with it."""

    def __init__(self, bench: Bench, name: str, modest: bool = False) -> None:
        self._bench, self._name = bench, f"{name}-{os.getpid()}-{bench.emulator.popen.pid}"
        self._modest = modest
        self.started: list[Process] = []

    def __enter__(self) -> Streams:
        try:
            self.start()
            self.recorder = Recorder(self._name, self._bench.folder, self._modest)
        except BaseException:
            self.__exit__()
            raise
        return self

    def start(self) -> Process:
        """Start outlets, once more where they were killed."""
        log = self._bench.folder / f"{self._name}-{len(self.started)}.log"
        source = ("--emulator-json", json.dumps(self._bench.emulator.ready), "--data", str(self._bench.data))
        self.started.append(Process("stimrig.rig.lsl_outlets", *source, "--name", self._name, log=log))
        return self.started[-1]

    def wait_sent(self, test_id: str, timeout_s: float = 60.0) -> None:
        """Until the newest outlets have sent all of a test."""
        end_s = time.monotonic() + timeout_s
        while f"{test_id}.journal: " not in self.started[-1].log.read_text():
            if time.monotonic() > end_s:
                raise TimeoutError(self.started[-1].log.read_text())
            time.sleep(0.05)

    def end(self) -> dict[str, Any]:
        """End the outlets, then the recorder; what it recorded."""
        assert self.started[-1].stop() == 0, self.started[-1].log.read_text()
        return self.recorder.end()

    def __exit__(self, *_: object) -> None:
        for process in self.started:
            process.stop(signal.SIGKILL)
        if hasattr(self, "recorder"):
            self.recorder.process.stop(signal.SIGKILL)


@dataclass(frozen=True)
class Compared:
    """Each sample of the sealed recording against the stream: differences of the times, s."""

    torque_apart_s: np.ndarray
    pulses_apart_s: np.ndarray
    samples_more: int


def compare(recorded: dict[str, Any], path: str | Path) -> Compared:
    """Find a test of the stream by its marks and compare. Raises AssertionError where values differ or are lost."""
    with h5py.File(path) as file:
        columns = {name: file[name][:] for name in ("torque/time_s", "torque/torque_nm", "pulses/written_time_s")}
        widths_us, current_ma = file["pulses/sent_pulse_width_us"][:], file["pulses/current_ma"][:]
        test_id = file.attrs["test_id"]
        speed = json.loads(file.attrs["configuration"])["rig"].get("clock_speed", 1.0)
    marks = [(time_s, json.loads(mark)) for time_s, mark in zip(recorded["tests_s"], recorded["tests"], strict=True)]
    begin_s, end_s = (
        next(time_s for time_s, mark in marks if mark["event"] == event and mark["test_id"] == test_id)
        for event in ("start", "end")
    )
    near = slice(*np.searchsorted(recorded["torque_s"], [begin_s - 0.05, end_s + 0.05]))
    time_s, torque_nm = recorded["torque_s"][near] - begin_s, recorded["torque"][near, 0]
    wanted_s, wanted_nm = columns["torque/time_s"] / speed, columns["torque/torque_nm"]
    first = next((i for i in range(200) if np.array_equal(torque_nm[i : i + 5], wanted_nm[:5])), None)
    assert first is not None, "the stream lacks the recording's first samples"
    last = first + len(wanted_nm)
    assert np.array_equal(torque_nm[first:last], wanted_nm), "torque differs, or samples are lost or doubled"
    inside = (recorded["pulses_s"] > begin_s - 0.05) & (recorded["pulses_s"] < end_s + 0.05)
    pulses, pulse_s = recorded["pulses"][inside], recorded["pulses_s"][inside] - begin_s
    sent = np.flatnonzero(np.isfinite(columns["pulses/written_time_s"]))
    assert np.array_equal(pulses, np.column_stack([widths_us[sent], current_ma[sent], sent])), "pulses differ"
    return Compared(
        np.abs(time_s[first:last] - wanted_s),
        np.abs(pulse_s - columns["pulses/written_time_s"][sent] / speed),
        len(time_s) - len(wanted_s),
    )


def main() -> int:
    """Record until SIGTERM."""
    if "modest" in sys.argv[3:]:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(10)
    import pylsl

    name, out = sys.argv[1:3]
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    inlets = {}
    for part in STREAMS:
        found = pylsl.resolve_byprop("name", f"{name}-{part}", timeout=20)
        if not found:
            print(f"no stream {name}-{part}", file=sys.stderr)
            return 1
        inlets[part] = pylsl.StreamInlet(found[0], as_numpy=False)
        inlets[part].open_stream(20)
        inlets[part].time_correction(20)
    print(json.dumps({"info": {part: inlet.info(20).as_xml() for part, inlet in inlets.items()}}), flush=True)
    values: dict[str, list[Any]] = {part: [] for part in STREAMS}
    times_s: dict[str, list[float]] = {part: [] for part in STREAMS}
    quiet = 0
    while not ended.is_set() or quiet < 5:
        quiet = 0 if pull(inlets, values, times_s) else quiet + 1
        time.sleep(0.05)
    content: dict[str, Any] = {}
    for part in STREAMS:
        text = part == "tests"
        rows = [row[0] for row in values[part]] if text else values[part]
        content[part], content[f"{part}_s"] = np.array(rows, str if text else float), np.array(times_s[part])
        if not text and not rows:
            content[part] = np.empty((0, inlets[part].channel_count))
    np.savez(out, **content)
    return 0


def pull(inlets: dict[str, Any], values: dict[str, list[Any]], times_s: dict[str, list[float]]) -> bool:
    """Take what is there, with its clock's offset added; whether there was anything."""
    some = False
    for part, inlet in inlets.items():
        rows, stamps = inlet.pull_chunk(0.0, max_samples=100_000)
        offset_s = inlet.time_correction(20) if stamps else 0.0
        values[part].extend(rows)
        times_s[part].extend(stamp + offset_s for stamp in stamps)
        some = some or bool(stamps)
    return some


if __name__ == "__main__":
    sys.exit(main())
