"""Hostile files through the service's own workers: each must be refused in one line or read as sound.

A file goes the way of an upload: a worker fits it, confined as in the service. A model goes the way of a comparison.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.workers.pool import Pool
from stimrig.api.workers.process import Places
from tests.harness.hostile_shapes import SECRET, Hostile, good

LONGEST_LINE = 400


@dataclass
class Tally:
    """What became of the files."""

    tried: int = 0
    refused: int = 0
    sound: int = 0
    died: int = 0
    failed: list[str] = field(default_factory=list)
    peak_mb: float = 0.0
    peak_by: str = ""
    longest_s: float = 0.0
    longest_by: str = ""
    kinds: Counter[str] = field(default_factory=Counter)

    def note(self, hostile: Hostile, error: ApiError | None, found: str) -> None:
        """One file's end: refused, sound, or what nobody wants."""
        self.tried += 1
        self.kinds[hostile.suffix] += 1
        if SECRET[:20].decode() in found or SECRET[:20].decode() in str(error):
            self.failed.append(f"{hostile.name}: gave the secret away")
        elif error is None:
            self.sound += 1
            if hostile.refused:
                self.failed.append(f"{hostile.name}: was taken as sound")
        elif error.status == 422 and "\n" not in error.detail and len(error.detail) < LONGEST_LINE:
            self.refused += 1
        else:
            self.died += error.code == "worker-died"
            self.failed.append(f"{hostile.name}: {error.status} {error.detail[:200]}")


async def run(files: Callable[[Path], Iterable[Hostile]], progress: Callable[[str], Any] | None = None) -> Tally:
    """Try all files with one worker; `files` takes a folder for what they point to."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as scratch:
        beside, uploads = Path(scratch) / "service", Path(scratch) / "uploads"
        beside.mkdir()
        uploads.mkdir()
        (uploads / "sound.h5").write_bytes(good())
        pool = Pool(1, places=Places([uploads]))
        try:
            await pool.submit("warm").result
            for hostile in files(beside):
                await one(pool, uploads, hostile, tally)
                if progress is not None and tally.tried % 50 == 0:
                    progress(f"{tally.tried} files, {len(tally.failed)} not as they should be")
        finally:
            await pool.close()
    return tally


async def one(pool: Pool, uploads: Path, hostile: Hostile, tally: Tally) -> None:
    """Have a worker read one file; its memory is counted from anew."""
    path = uploads / f"upload{hostile.suffix}"
    path.write_bytes(hostile.content)
    worker = pool.workers[0]
    process = await worker.start()
    reset_peak(process.pid)
    began = time.monotonic()
    error, found = None, ""
    try:
        if hostile.suffix == ".json":
            text = hostile.content.decode("latin-1")
            call = pool.submit("comparison", data=str(uploads / "sound.h5"), model_json=text)
        else:
            call = pool.submit("fit", data=str(path))
        found = json.dumps(await call.result)
    except ApiError as problem:
        error = problem
    taken_s = time.monotonic() - began
    tally.note(hostile, error, found)
    if taken_s > tally.longest_s:
        tally.longest_s, tally.longest_by = round(taken_s, 2), hostile.name
    peak_mb = peak(process.pid)
    if peak_mb > tally.peak_mb:
        tally.peak_mb, tally.peak_by = round(peak_mb), hostile.name


def reset_peak(pid: int) -> None:
    """Count a process's peak memory from now on, where the system lets us."""
    try:
        Path(f"/proc/{pid}/clear_refs").write_text("5")
    except OSError:
        return


def peak(pid: int) -> float:
    """Peak of a process's resident memory, MB; 0 where it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")), 0.0)
