"""What a centre is told of a row: codes and figures.

What a person typed freely stays at the rig: notes, and the reason of a decision. So do paths. The audit trail stays,
too; the centre gets the hash of each entry, by which it can be told later whether the trail was changed.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from stimrig.api.outbox.chain import Telling
from stimrig.api.store import uploads
from stimrig.api.store.hashes import canonical
from stimrig.api.store.tables import (
    OPEN_STATES,
    Approval,
    AuditEntry,
    Model,
    Participant,
    Recording,
    Table,
    Test,
    Tracked,
)

TABLES: dict[type[Table], str] = {
    Participant: "participant", Recording: "recording", Model: "model", Test: "test", Approval: "decision",
    Tracked: "tracked", AuditEntry: "audit",
}  # fmt: skip
"""What is told of, in the order in which one transaction's rows are told."""
LONGEST_BODY = 500_000
LONGEST_LIST = 100
DEEPEST = 20
OF_SERVICES = ("followed_by", "rig")
"""Columns of a test that say which service follows it, and at which socket."""
SHA256 = re.compile(r"[0-9a-f]{64}")


def telling(row: Table) -> Telling | None:
    """What is told of a row; None where nothing is: a test that goes on."""
    if isinstance(row, Test):
        return None if row.state in OPEN_STATES else Telling("test", row.id, _bounded(_test(row)))
    if isinstance(row, Recording):
        return _recording(row)
    if isinstance(row, Model | Tracked):
        return _with_document(row)
    if isinstance(row, AuditEntry):
        body = {"seq": row.seq, "hash": row.hash, "previous_hash": row.previous_hash, "at_utc": row.at_utc}
        return Telling("audit", str(row.seq), body)
    if isinstance(row, Approval):
        return Telling("decision", str(row.id), _bounded(_without(row, "reason", "site")))
    if isinstance(row, Participant):
        return Telling("participant", row.code, _bounded(_without(row, "placement")))
    return None


def _test(row: Test) -> dict[str, Any]:
    plan = dict(row.plan or {})
    preview = plan.get("preview")
    if isinstance(preview, dict):
        plan["preview"] = {name: value for name, value in preview.items() if not isinstance(value, list)}
    body = {**row.as_dict(), "plan": plan}
    return {name: value for name, value in body.items() if name not in OF_SERVICES}


def _recording(row: Recording) -> Telling:
    body = _bounded({**_without(row, "path", "site"), "name": Path(row.path).name})
    if not SHA256.fullmatch(row.file_sha256):
        return Telling("recording", row.id, body)
    return Telling("recording", row.id, body, row.file_sha256, length_of(Path(row.path)))


def length_of(path: Path) -> int | None:
    """A file's length; an upload's is in a folder of its own until its row is written. None: it is not there."""
    for place in (path, uploads.part_of(path)):
        try:
            return place.stat().st_size
        except OSError:
            continue
    return None


def _with_document(row: Model | Tracked) -> Telling:
    kind, key = ("model", row.id) if isinstance(row, Model) else ("tracked", row.test_id)
    body = _bounded(_without(row, "document"))
    if row.document is None or row.etag is None or not SHA256.fullmatch(row.etag):
        return Telling(kind, key, body)
    return Telling(kind, key, body, row.etag, len(row.document))


def _without(row: Table, *columns: str) -> dict[str, Any]:
    """The row as a plain object but for some columns."""
    return {name: value for name, value in row.as_dict().items() if name not in columns}


def _bounded(body: dict[str, Any]) -> dict[str, Any]:
    """The body as JSON knows it, and not longer than fits well into a batch."""
    plain: dict[str, Any] = _plain(json.loads(json.dumps(body)))
    if len(canonical(plain)) <= LONGEST_BODY:
        return plain
    plain = {name: _shortened(value) for name, value in plain.items()}
    if len(canonical(plain)) <= LONGEST_BODY:
        return plain
    return {name: value for name, value in plain.items() if not isinstance(value, dict | list)}


def _plain(value: Any, depth: int = 0) -> Any:
    """Without what JSON or UTF-8 cannot hold, a number that is none is null; and not nested without end."""
    if isinstance(value, dict | list) and depth >= DEEPEST:
        return {"left_out": len(value)}
    if isinstance(value, dict):
        return {_plain(name): _plain(each, depth + 1) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each, depth + 1) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value.encode(errors="replace").decode() if isinstance(value, str) else value


def _shortened(value: Any) -> Any:
    """Long lists left out."""
    if isinstance(value, dict):
        return {name: _shortened(each) for name, each in value.items()}
    if isinstance(value, list):
        return {"left_out": len(value)} if len(value) > LONGEST_LIST else [_shortened(each) for each in value]
    return value
