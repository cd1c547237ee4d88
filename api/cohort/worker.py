"""What a worker of Dask does with a record: fetch it, hash it, have it computed; a row in any case.

The worker itself never looks into a record: that is done by a process that is shut in (`stimrig.api.cohort.child`).
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from typing import Any

from stimrig.api.cohort.parent import computing
from stimrig.api.cohort.sources import Entry, Source, SourceError
from stimrig.api.cohort.tasks import Task
from stimrig.api.version import software_version
from stimrig.identify.records.bounds import LARGEST_FILE_BYTES

LEFT_OUT, COPY = "left out", "copy"
"""Status of rows that are kept until the end, so that a record is not read again, and not handed out."""
MINE = ("address", "stamp", "sha256", "bytes", "verb", "software", "origin")
"""Columns that a record has no say in."""
TOO_LARGE = f"more than {LARGEST_FILE_BYTES // 2**20} MB. Cut the record, or give the sealed recording."


@dataclass(frozen=True)
class Bounds:
    """What one record may take: seconds, bytes beyond the libraries; and after how many records a process ends."""

    limit_s: float
    memory_bytes: int
    records: int


Record = tuple[Source, Entry, tuple[bytes, ...]]
"""A record, and digests of contents that it need not be computed again."""


@dataclass(frozen=True)
class Done:
    """What a worker did of a parcel: the rows of its first records, and how long that took."""

    rows: list[dict[str, Any]]
    took_s: float
    other_version: str = ""
    """The worker's version, where it is another than that of who asks; then there are no rows."""


def run_parcel(records: list[Record], task: Task, bounds: Bounds, patience_s: float) -> Done:
    """Records one after the other, the first in any case, until `patience_s` is over; the others are not begun."""
    began_s, rows = time.monotonic(), list[dict[str, Any]]()
    if software_version() != task.software:
        return Done(rows, 0.0, software_version())
    for source, entry, done in records:
        rows.append(run_record(source, entry, task, bounds, done))
        if time.monotonic() - began_s > patience_s:
            break
    return Done(rows, time.monotonic() - began_s)


def run_record(
    source: Source, entry: Entry, task: Task, bounds: Bounds, done: tuple[bytes, ...] = ()
) -> dict[str, Any]:
    """One record's row; its `status` is `ok`, `error`, `left out` of the selection, or `copy` of what is in `done`."""
    base: dict[str, Any] = {**entry.known, **identity(entry), "verb": task.verb, "software": task.software}
    try:
        if entry.bytes is not None and entry.bytes > LARGEST_FILE_BYTES:
            return {**base, **_failed("bad record", TOO_LARGE)}
        content = source.open(entry, LARGEST_FILE_BYTES)
    except SourceError as error:
        return {**base, **_failed("unreadable", str(error))}
    if len(content) > LARGEST_FILE_BYTES:
        return {**base, **_failed("bad record", TOO_LARGE)}
    sha256 = hashlib.sha256(content).hexdigest()
    base |= {"bytes": len(content), "sha256": sha256}
    if entry.sha256 and sha256 != entry.sha256:
        line = f"its content differs from its hash: {sha256[:12]}…, not {entry.sha256[:12]}…. Seal or send it again."
        return {**base, **_failed("hash differs", line)}
    if done and digest(sha256) in done:
        return {**base, "status": COPY}
    process = computing(bounds.memory_bytes, bounds.records)
    found = process.compute(content, entry, task, bounds.limit_s)
    row = found.get("row", {"status": LEFT_OUT})
    mine = {name: base[name] for name in MINE if name in base}  # whatever the process says
    return {**base, **row, **mine, "left_open": process.left_open}


def digest(*words: str) -> bytes:
    """Sixteen bytes that stand for texts: a cohort may have millions of records."""
    return hashlib.blake2b("\0".join(words).encode("utf-8", "replace"), digest_size=16).digest()


def identity(entry: Entry) -> dict[str, Any]:
    """What tells a record from all others, and its content of now from that of another time."""
    return {"address": entry.address, "stamp": entry.stamp}


def _failed(kind: str, line: str) -> dict[str, Any]:
    return {"status": "error", "error_kind": kind, "error": line, "took_s": 0.0}


def lost(entry: Entry, task: Task, line: str) -> dict[str, Any]:
    """The row of a record with which its worker was lost."""
    base = {**entry.known, **identity(entry), "verb": task.verb, "software": task.software}
    return {**base, **_failed("killed", line)}
