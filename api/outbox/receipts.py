"""Heads of the audit trail that stand outside the database: countersigned by a centre, or noted in a file.

Whoever edits the trail and makes its chain anew from there on cannot make these anew, too (decision 0015).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.store import Store, audit
from stimrig.api.store.audit import GENESIS, canonical
from stimrig.api.store.tables import AuditEntry

HOUR_S = 3600.0
Hex = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, StringConstraints(max_length=200)]


class Receipt(BaseModel):
    """A head of the trail as it was noted: an entry's number and hash, and when."""

    model_config = ConfigDict(strict=True, frozen=True)

    seq: Annotated[int, Field(ge=0, le=2**53)]
    hash: Hex
    noted_utc: Text  # when the centre received it, or it was written down
    at_utc: Text = ""  # the entry's own time
    rig: Text = ""  # as whose it was told
    chain: Text = ""
    item: Annotated[int, Field(ge=0, le=2**53)] = 0  # of the outbox, with which it was told
    key: Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{64})?$")] = ""
    """The centre's Ed25519 key; empty, as its signature, where a rig noted its head by itself."""
    signature: Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{128})?$")] = ""  # of all the rest

    @property
    def signed(self) -> bytes:
        return canonical(self.model_dump(exclude={"signature"})).encode(errors="replace")

    @property
    def holds(self) -> bool:
        """Whether it says what the centre signed."""
        if not self.key:
            return not self.signature
        try:
            Ed25519PublicKey.from_public_bytes(bytes.fromhex(self.key)).verify(
                bytes.fromhex(self.signature), self.signed
            )
        except (InvalidSignature, ValueError):
            return False
        return True


@dataclass(frozen=True)
class Standing:
    """How the trail stands against what was noted of it."""

    first_broken: int | None  # the first entry that does not hold, or that differs from the one noted
    missing_since: int | None  # the first entry that was noted and is gone, as after the restore of a backup
    differs: Receipt | None  # what was noted of the first
    missing: Receipt | None  # and of the second


def standing(entries: Sequence[AuditEntry], noted: Sequence[Receipt]) -> Standing:
    """The chain, and each entry beside what was noted of it.

    Once a rig has begun a chain of items anew, after a restore, entries later than those noted stand in their places.
    """
    trail = {0: GENESIS} | {entry.seq: entry.hash for entry in entries}
    times = {entry.seq: entry.at_utc for entry in entries}
    newest = {(one.key, one.rig): one.chain for one in noted}
    differing = sorted((one for one in noted if trail.get(one.seq) != one.hash), key=lambda one: one.seq)
    gone = [
        one for one in differing
        if one.seq not in trail or (newest[one.key, one.rig] != one.chain and times.get(one.seq, "") > one.at_utc)
    ]  # fmt: skip
    differs = next((one for one in differing if one not in gone), None)
    missing = gone[0] if gone else None
    broken = [seq for seq in (audit.first_broken(list(entries)), differs and differs.seq) if seq is not None]
    return Standing(min(broken, default=None), missing and missing.seq, differs, missing)


def check_folder(entries: Sequence[AuditEntry], folder: Path) -> Standing:
    """`standing` with the receipts in a data folder; their signatures are left to `stimrig audit verify`."""
    return standing(entries, [one for path in files(folder) for _, one in read(path) if one is not None])


def files(folder: Path) -> list[Path]:
    """The receipts in a data folder: a file for each centre and key."""
    return sorted(folder.glob("receipts-*.jsonl"))


def read(path: Path) -> Iterator[tuple[int, Receipt | None]]:
    """Number of each line and what it says; None where it is no receipt. Raises OSError."""
    with path.open("rb") as lines:
        for number, line in enumerate(lines, start=1):
            try:
                yield number, Receipt.model_validate_json(line)
            except ValidationError:
                yield number, None


def checked(path: Path) -> tuple[list[Receipt], list[str]]:
    """The receipts of a file, and what is wrong with it: lines that were changed, or taken out. Raises OSError."""
    kept, wrong = [], []
    seqs: dict[tuple[str, str, str], set[int]] = {}
    for number, one in read(path):
        if one is None or not one.holds:
            wrong.append(f"{path}, line {number}: not as it was written; the file was changed")
            continue
        kept.append(one)
        if one.key:
            seqs.setdefault((one.key, one.rig, one.chain), set()).add(one.seq)
    for noted in seqs.values():
        hole = next((one + 1 for one, after in pairwise(sorted(noted)) if after != one + 1), None)
        if hole is not None:
            wrong.append(f"{path}: the receipt of entry {hole} is missing; the file was cut")
    return kept, wrong


def append(path: Path, noted: Iterable[Receipt]) -> None:
    """Write them to a file's end, down to the disk. Raises OSError."""
    owner_only.file(path)
    with path.open("ab") as file:
        for one in noted:
            file.write(one.model_dump_json(exclude_defaults=True).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def head(store: Store, clock: Clock) -> Receipt:
    """The trail's present end."""
    newest = store.first(AuditEntry, order=AuditEntry.seq.desc())
    seq, hash_, at_utc = (newest.seq, newest.hash, newest.at_utc) if newest else (0, GENESIS, "")
    return Receipt(seq=seq, hash=hash_, noted_utc=clock.utc(), at_utc=at_utc)


def note_hourly(store: Store, clock: Clock, path: Path) -> None:
    """Write the trail's end to a file, once an hour. Raises OSError."""
    if not path.exists() or clock.unix_s() - path.stat().st_mtime >= HOUR_S:
        append(path, [head(store, clock)])
