"""`python -m bench.hostile_files [--count N] [--seed S] [--json]`: files as weapons, through the service's own workers.

Each file (`tests/harness/hostile_shapes.py`) goes the way of an upload: a worker fits it, confined as in the service.
A model goes the way of a comparison. Printed: how many were tried, refused in one clear line, taken as sound, and how
many ended in a crash or an error that nobody expected (none is wanted); the workers' peak memory and the longest time.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from api.errors import ApiError
from api.workers.pool import Pool
from api.workers.process import Places
from tests.harness.hostile_shapes import SECRET, Hostile, all_files, good

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


async def run(count: int, seed: int, say: Any = None) -> Tally:
    """Try them all with one worker."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as scratch:
        beside, uploads = Path(scratch) / "service", Path(scratch) / "uploads"
        beside.mkdir()
        uploads.mkdir()
        (uploads / "sound.h5").write_bytes(good())
        pool = Pool(1, places=Places([uploads]))
        try:
            await pool.submit("warm").result
            for hostile in all_files(beside, seed, count):
                await one(pool, uploads, hostile, tally)
                if say is not None and tally.tried % 50 == 0:
                    say(f"{tally.tried} files, {len(tally.failed)} not as they should be")
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


def main() -> int:
    """Run; 1 where something was not as it should be."""
    parser = argparse.ArgumentParser(prog="bench.hostile_files")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    logging.disable(logging.WARNING)  # each refusal would be a line
    tally = asyncio.run(run(options.count, options.seed, lambda line: print(line, file=sys.stderr)))
    if options.json:
        print(json.dumps(asdict(tally)))
    else:
        print(
            f"{tally.tried} files ({', '.join(f'{n} {kind}' for kind, n in tally.kinds.items())}), seed {options.seed}"
        )
        print(f"refused in one line {tally.refused}, taken as sound {tally.sound}, worker died {tally.died}")
        print(f"peak memory {tally.peak_mb:g} MB ({tally.peak_by}), longest {tally.longest_s} s ({tally.longest_by})")
        print("\n".join(["not as it should be:", *tally.failed]) if tally.failed else "all as it should be")
    return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(main())
