"""Hostile files through the service's own workers: each must be refused in one line or read as sound.

A file goes the way of an upload: a worker fits it, confined as in the service.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from stimrig.api.errors import ApiError
from stimrig.api.workers.pool import Pool
from stimrig.api.workers.process import Places
from tests.harness.hostile_shapes import SECRET, Hostile

LONGEST_LINE = 400


@dataclass
class Tally:
    """What became of the files."""

    refused: int = 0
    sound: int = 0
    failed: list[str] = field(default_factory=list)


async def run(files: Callable[[Path], Iterable[Hostile]]) -> Tally:
    """Try all files with one worker; `files` takes a folder for what they point to."""
    tally = Tally()
    with tempfile.TemporaryDirectory() as scratch:
        beside, uploads = Path(scratch) / "service", Path(scratch) / "uploads"
        beside.mkdir()
        uploads.mkdir()
        pool = Pool(1, places=Places([uploads]))
        try:
            for hostile in files(beside):
                await _try(pool, uploads / f"upload{hostile.suffix}", hostile, tally)
        finally:
            await pool.close()
    return tally


async def _try(pool: Pool, path: Path, hostile: Hostile, tally: Tally) -> None:
    path.write_bytes(hostile.content)
    try:
        found = json.dumps(await pool.submit("fit", data=str(path)).result)
    except ApiError as error:
        found = error.detail
        tally.refused += 1
        if error.status != 422 or "\n" in found or len(found) >= LONGEST_LINE or error.code == "worker-died":
            tally.failed.append(f"{hostile.name}: {error.status} {found[:200]}")
    else:
        tally.sound += 1
        if hostile.refused:
            tally.failed.append(f"{hostile.name}: was taken as sound")
    if SECRET[:20].decode() in found:
        tally.failed.append(f"{hostile.name}: gave the secret away")
