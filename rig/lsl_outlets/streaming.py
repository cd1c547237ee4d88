"""Follows one test after another and sends what its journal holds, as `python -m stimrig.rig.lsl_outlets`."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import logging
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.rig import config as configuration
from stimrig.rig import journal, logs
from stimrig.rig.clock import MonotonicClock
from stimrig.rig.errors import ConfigError, RecordingError, RigError
from stimrig.rig.journal import MAGIC, Kind
from stimrig.rig.lsl_outlets.live_test import Batch, LiveTest

AT_ONCE_BYTES = 1 << 18
FREE_TO_READ = {0xEF53: "ext2 to ext4", 0x9123683E: "btrfs", 0x01021994: "tmpfs", 0x794C7630: "overlay"}
"""File systems, by their magic number (statfs(2)), on which reading a file never makes its writer wait. On XFS and
over NFS a read holds the file's lock: a reader of low priority that is interrupted would hold up the rig."""


def refuse_locking(folder: Path) -> None:
    """Raise RecordingError if the folder lies where a reader could hold up the writer."""
    found = ctypes.create_string_buffer(256)
    if ctypes.CDLL(None, use_errno=True).statfs(os.fsencode(folder), found) != 0:
        raise RecordingError(f"{folder}: {os.strerror(ctypes.get_errno())}; give the rig's data folder with --data")
    magic = ctypes.cast(found, ctypes.POINTER(ctypes.c_long))[0]
    if magic not in FREE_TO_READ:
        raise RecordingError(
            f"{folder}: lies on a file system (number {magic:#x}) on which reading may hold up the rig's writing, so "
            f"nothing is streamed; put the data folder on one of: {', '.join(FREE_TO_READ.values())}"
        )


class Tail:
    """One journal, read from its start on. It takes no lock, and writes nothing, not even the time of access.

    Raises OSError: it is gone, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NOATIME)
        except PermissionError:  # only the owner may ask for that
            self._fd = os.open(path, os.O_RDONLY)
        self._read = 0
        self._buffer = b""
        self.damaged_bytes = 0

    def blocks(self) -> list[tuple[Kind, bytes]]:
        """The blocks that came since, at most `AT_ONCE_BYTES` of them; a damaged one is left out."""
        piece = os.pread(self._fd, AT_ONCE_BYTES, self._read)
        if self._read == 0:
            if len(piece) < len(MAGIC):
                return []
            self._read, piece = len(MAGIC), piece[len(MAGIC) :]
        self._read += len(piece)
        if not piece:
            return []
        self._buffer += piece
        found, end, damaged = journal.whole_blocks(self._buffer, 0)  # of what follows some may not have come yet
        self.damaged_bytes += damaged
        self._buffer = self._buffer[end:]
        return [(kind, payload) for kind, _, payload in found]

    def left(self) -> bool:
        """Whether the rig has sealed it, or moved it aside."""
        try:
            here, there = os.fstat(self._fd), self.path.stat()
        except OSError:
            return True
        return (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino)

    def close(self) -> None:
        os.close(self._fd)


class Journals:
    """The folder of journals: which one to follow next.

    One that lay there before and does not grow was left by a crash; the rig deals with it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sizes = {path: size for path, _, size in self._listed()}
        self.old = set(self._sizes)
        """Those that were there at the start: if one grows, its test was running already."""

    def following(self, besides: Path | None = None) -> Path | None:
        """The oldest journal that is written and was not followed yet, other than that one; None: there is none."""
        listed = self._listed()
        for gone in self._sizes.keys() - {path for path, _, _ in listed}:
            del self._sizes[gone]
            self.old.discard(gone)
        for path, _, size in sorted(listed, key=lambda entry: entry[1]):
            if size != self._sizes.get(path) and path != besides:
                return path
        return None

    def done(self, path: Path) -> None:
        """It was followed to its end."""
        with contextlib.suppress(OSError):
            self._sizes[path] = path.stat().st_size

    def _listed(self) -> list[tuple[Path, float, int]]:
        found = []
        with contextlib.suppress(OSError), os.scandir(self._folder) as entries:
            for entry in entries:
                if entry.name.endswith(".journal"):
                    with contextlib.suppress(OSError):
                        stat = entry.stat()
                        found.append((Path(entry.path), stat.st_mtime, stat.st_size))
        return found


PULSE_CHANNELS = (("pulse_width", "µs"), ("current", "mA"), ("index", "1"))


class NoLibraryError(RigError, code="no-library", title="LSL is not installed"):
    """It names what to install."""


def library() -> Any:
    """pylsl with its library. Raises NoLibraryError."""
    try:
        import pylsl
    except (ImportError, RuntimeError, OSError) as error:
        said = " ".join(str(error).split())[:200]
        raise NoLibraryError(f"lsl: pylsl is not there ({said}); pip install 'stimrig[lsl]'") from None
    return pylsl


def clock_offset_s(lsl: Any) -> float:
    """LSL's clock minus the rig's at speed 1, s: on Linux what the machine was suspended, and the readings' delay."""
    clock, shortest_s, offset_s = MonotonicClock(), np.inf, 0.0
    for _ in range(20):
        before_s, lsl_s, after_s = clock.now_s(), lsl.local_clock(), clock.now_s()
        if after_s - before_s < shortest_s:
            shortest_s, offset_s = after_s - before_s, lsl_s - (before_s + after_s) / 2
    return offset_s


class Outlets:
    """Torque, pulses and marks: three streams that exist for as long as the process, whether a test plays or not.

    So a LabRecorder that was started before the first test records them all. What differs from test to test (its ids,
    the participant's code, begin and end) goes out as marks.

    `sample_rate_hz`: nominal rate of the cell in samples per real second; 0: not known. `devices`: load cell and
    stimulator, as the rig file names them. `several`: whether each pulse tells its channel (its place in the rig file).
    """

    def __init__(
        self, lsl: Any, sample_rate_hz: float, devices: dict[str, str], name: str = "stimrig", several: bool = False
    ) -> None:
        self._lsl, self._name, self._devices, self._several = lsl, name, devices, several
        of_pulses = (*PULSE_CHANNELS, ("channel", "1")) if several else PULSE_CHANNELS
        self._torque = self._open("torque", "Torque", sample_rate_hz, lsl.cf_double64, (("torque", "N·m"),))
        self._pulses = self._open("pulses", "Stimulation", 0.0, lsl.cf_double64, of_pulses)
        self._marks = self._open("tests", "Markers", 0.0, lsl.cf_string, (("mark", "JSON"),))

    @property
    def names(self) -> list[str]:
        return [f"{self._name}-{part}" for part in ("torque", "pulses", "tests")]

    def push(self, batch: Batch) -> None:
        """Send a batch; it does not wait for those who receive."""
        for time_s, mark in batch.marks:
            if mark["event"] == "start":
                self._mark(time_s, mark)
        if len(batch.torque_s):
            self._torque.push_chunk(batch.torque_nm.reshape(-1, 1), batch.torque_s.tolist())
        if batch.pulses:
            values = np.array(batch.pulses, np.float64)
            if self._several:
                values = np.column_stack([values, batch.channels])
            self._pulses.push_chunk(values, batch.pulse_s)
        for time_s, mark in batch.marks:
            if mark["event"] != "start":
                self._mark(time_s, mark)

    def wanted(self, which: Callable[[Iterable[bool]], bool] = any) -> bool:
        """Whether somebody receives any, or all, of them."""
        return which(outlet.have_consumers() for outlet in (self._torque, self._pulses, self._marks))

    def _mark(self, time_s: float, mark: dict[str, Any]) -> None:
        self._marks.push_sample([json.dumps(mark, ensure_ascii=False)], time_s)

    def _open(self, part: str, kind: str, rate_hz: float, form: int, channels: tuple[tuple[str, str], ...]) -> Any:
        lsl = self._lsl
        source = f"{self._name}-{part}-{socket.gethostname()}"
        info = lsl.StreamInfo(f"{self._name}-{part}", kind, len(channels), rate_hz, form, source)
        description = info.desc()
        description.append_child_value("manufacturer", "stimrig")
        for device, model in self._devices.items():
            description.append_child_value(device, model)
        listed = description.append_child("channels")
        for label, unit in channels:
            channel = listed.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
            channel.append_child_value("type", kind)
        return lsl.StreamOutlet(info)


log = logging.getLogger("rig.lsl")

TICK_S = 0.05
LOOK_S = 0.2
"""Real seconds between two looks for a new test, or whether the journal is still there."""
LAST_S = 0.5
"""Real seconds that receivers have at the end to fetch what was sent."""
RETURN_S = 15.0
"""Real seconds for which a test that was joined waits until those who received before have found the streams again."""
READS_AT_END = 400
"""A test of the longest duration makes 25 MB; each read takes `follow.AT_ONCE_BYTES` at most."""


class Streaming:
    """Follows one test after another and sends what they hold."""

    def __init__(self, folder: Path, streams: Outlets, offset_s: float, sample_rate_hz: float, speed: float) -> None:
        self._journals = Journals(folder / "journals")
        self._streams, self._offset_s = streams, offset_s
        self._rate_hz, self._speed = sample_rate_hz, speed
        self._tail: Tail | None = None
        self._test = LiveTest()
        self._joined = False
        self._began_s = time.monotonic()
        self._looked_s = -LOOK_S

    def tick(self) -> bool:
        """Take and send what came; whether there was anything."""
        if self._tail is None and not self._found():
            return False
        tail = self._tail
        assert tail is not None
        try:
            blocks = tail.blocks()
        except OSError as error:
            log.warning("%s: %s; nothing more of this test is streamed", tail.path.name, error.strerror)
            self._finish()
            return False
        for kind, payload in blocks:
            self._take(kind, payload)
        if self._waiting():
            return bool(blocks)
        if self._test.ended:
            self._finish()
        elif blocks:
            self._streams.push(self._test.ready())
        elif self._due() and (tail.left() or self._journals.following(tail.path) is not None):
            log.warning("%s: its test ended without an end in its journal", tail.path.name)
            self._finish()
        return bool(blocks)

    def close(self) -> None:
        for _ in range(READS_AT_END):  # a rig that goes on writes faster than this could come to an end
            if self._tail is None or not self.tick():
                break
        if self._tail is not None:
            self._finish()

    def _waiting(self) -> bool:
        """After a start in the middle of a test: what is sent before the receivers are back would be lost to them."""
        early = time.monotonic() < self._began_s + RETURN_S
        return self._joined and early and not self._streams.wanted(all)

    def _due(self) -> bool:
        now_s = time.monotonic()
        if now_s < self._looked_s + LOOK_S:
            return False
        self._looked_s = now_s
        return True

    def _found(self) -> bool:
        path = self._journals.following() if self._due() else None
        if path is None:
            return False
        try:
            self._tail = Tail(path)
        except OSError as error:
            log.warning("%s: %s; this test is not streamed", path.name, error.strerror)
            self._journals.done(path)
            return False
        self._joined = path in self._journals.old
        since_s = self._began_s * self._speed if self._joined else float("-inf")
        self._test = LiveTest(self._offset_s, since_s, self._rate_hz or 1000.0)
        log.info("%s %s", "joins" if self._joined else "follows", path.name)
        return True

    def _take(self, kind: Kind, payload: bytes) -> None:
        try:
            self._test.take(kind, payload)
        except (ValueError, KeyError, TypeError, IndexError, struct.error) as error:
            log.warning("a block (%s) is not valid and is passed over: %r", kind.name, error)

    def _finish(self) -> None:
        assert self._tail is not None
        self._streams.push(self._test.ready(finish=True))
        name = self._tail.path.name
        if self._tail.damaged_bytes:
            log.warning("%s: %d bytes are damaged; what they held was not streamed", name, self._tail.damaged_bytes)
        log.info("%s: %d samples and %d pulses sent", name, self._test.sent_samples, self._test.sent_pulses)
        self._tail.close()
        self._journals.done(self._tail.path)
        self._tail = None


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m stimrig.rig.lsl_outlets", description="Torque and pulses for LSL.")
    configuration.add_arguments(parser, required=False, about="rig file: says rate and devices")
    parser.add_argument("--data", type=Path, metavar="DIR", help="data folder of the rig; overrides the rig file")
    parser.add_argument("--name", default="stimrig", help="what the streams' names begin with (default: stimrig)")
    options = parser.parse_args(arguments)
    logs.configure("lsl")
    try:
        # the rig's socket is not used
        config = configuration.chosen(options, data_dir=options.data, socket=Path("none"))
        folder = options.data or (config.data_dir if config is not None else None)
        if folder is None:
            raise ConfigError("lsl: give the rig's data folder with --data, or its rig file with --config")
        if not folder.is_dir():
            raise ConfigError(f"lsl: {folder}: no such folder; give the rig's data folder")
        refuse_locking(folder)
        _stream(folder, config, options.name)
    except RigError as error:
        print(f"lsl: {str(error).removeprefix('lsl: ')}", file=sys.stderr)
        return 2
    return 0


def _stream(folder: Path, config: configuration.RigConfig | None, name: str) -> None:
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    lsl = library()
    rate_hz, speed, devices, channels = 0.0, 1.0, dict[str, str](), list[str]()
    if config is not None:
        rate_hz = float(config.load_cell.model_dump().get("sample_rate_hz", 0.0))
        speed, channels = config.clock_speed, [channel.name for channel in config.channels()]
        devices = {"load_cell": config.load_cell.device, "stimulator": config.stimulator.device}
        if len(channels) > 1:
            devices["stimulator_channels"] = ", ".join(channels)
    streams = Outlets(lsl, rate_hz * speed, devices, name, len(channels) > 1)
    streaming = Streaming(folder, streams, clock_offset_s(lsl), rate_hz, speed)
    print(json.dumps({"streams": streams.names}), flush=True)
    while not ended.is_set():
        streaming.tick()
        ended.wait(TICK_S)
    streaming.close()
    if streams.wanted():
        time.sleep(LAST_S)
