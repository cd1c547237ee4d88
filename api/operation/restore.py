"""The way back from a backup: into empty data folders, or with what is there set aside. Nothing is deleted."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from stimrig.api.operation.backup import check
from stimrig.api.operation.copying import NO_METER, BackupError, Meter, copy, manifest, write
from stimrig.api.operation.state import STATE
from stimrig.api.whole_file import sha256_of, to_disk


class Restored(NamedTuple):
    """What a restore did: in words, and how many files have the SHA-256 of the manifest."""

    words: list[str]
    files_same: int


def restore(backup: Path, rig_data: Path, api_data: Path, force: bool, meter: Meter = NO_METER) -> Restored:
    """Put a backup back. The rig comes up latched: a person looks first.

    Raises BackupError: the backup does not hold, a process uses the data, or there are data and no `force`. Nothing was
    touched.
    """
    check(backup, meter)
    if _locked(rig_data / "rig.lock"):
        raise BackupError(f"{rig_data}: a rig runs on it; systemctl stop stimrig-rig stimrig-api first")
    if _locked(api_data / "service.lock") or _is_open(api_data / "stimrig.db"):
        raise BackupError(f"{api_data / 'stimrig.db'}: a service uses it; systemctl stop stimrig-api first")
    targets = list(dict.fromkeys((rig_data, api_data)))
    used = [folder for folder in targets if _holds_data(folder)]
    if used and not force:
        raise BackupError(f"{', '.join(map(str, used))}: holds data; --force sets it aside (and deletes nothing)")
    fresh = {target: target.with_name(f"{target.name}.restoring") for target in targets}
    for folder in fresh.values():
        if folder.exists():
            raise BackupError(f"{folder}: left by a restore that was cut short; look at it and remove it")
    _stage(backup / "rig", fresh[rig_data], ("journals", "recordings"), meter)
    _stage(backup / "api", fresh[api_data], ("recordings/rig",) if api_data != rig_data else (), meter)
    _latch(fresh[rig_data] / "latch.json", f"the data were restored from {backup.name}")
    same = _compare(backup, fresh[rig_data], fresh[api_data], meter)
    return Restored([words for target in targets for words in _replace(target, fresh[target])], same)


def _stage(source: Path, fresh: Path, folders: tuple[str, ...], meter: Meter) -> None:
    fresh.mkdir(parents=True, exist_ok=True, mode=0o700)
    sealed = {path.stem.partition("Z_")[2] for path in (source / "recordings").glob("*.h5")}
    for path in sorted(source.rglob("*")):
        if path.is_file() and not (path.suffix == ".journal" and path.stem in sealed):  # it ended during the backup
            meter.add(path, "copies")
            copy(path, fresh / path.relative_to(source))
    for folder in folders:
        (fresh / folder).mkdir(parents=True, exist_ok=True, mode=0o750)


def _latch(path: Path, reason: str) -> None:
    """A rig on restored data waits for a person; one that died in a test stays uncertain, which says more.

    A latch that cannot be read keeps nobody from the restore: the rig waits for a person then, too, and is told why.
    """
    state: object = "none"
    if path.exists():
        try:
            content = json.loads(path.read_bytes())
            state = content["state"]
        except (ValueError, KeyError, TypeError, RecursionError):
            reason += "; its latch could not be read, a test may have been under way"
    if state != "running":
        write(path, json.dumps({"state": "latched", "reason": reason}).encode())


def _replace(target: Path, fresh: Path) -> Iterator[str]:
    _own_like(fresh, target)
    if _holds_data(target):
        aside = target.with_name(f"{target.name}.before-{datetime.now(UTC):%Y%m%dT%H%M%SZ}")
        target.rename(aside)
        yield f"{target}: what was there is now in {aside}"
    elif target.exists():
        shutil.rmtree(target)
    fresh.rename(target)
    to_disk(target.parent)
    yield f"{target}: restored"


def _compare(backup: Path, rig: Path, api: Path, meter: Meter) -> int:
    """How many restored files have the hash of the manifest. Raises BackupError: one has another, or is not there.

    A journal whose recording is in the backup, too, is not restored; the latch is told anew.
    """
    same = 0
    for name, digest in manifest(backup)["sha256"].items():
        label, _, rest = name.partition("/")
        path = (rig if label == "rig" else api) / rest
        if path.suffix == ".journal" and not path.exists():
            continue
        if rest == "latch.json":
            continue
        meter.add(path, "compares")
        if not path.is_file() or sha256_of(path) != digest:
            raise BackupError(f"{path}: differs from the backup; is the disk sound? Nothing was replaced")
        same += 1
    return same


def _own_like(fresh: Path, target: Path) -> None:
    """The owner and mode that the data folder had: as root only, else they stay the caller's.

    The folder itself last: who owns it could put a link to a file of root's in the place of one in it.
    """
    if not target.exists():
        return
    owner = target.stat()
    if os.geteuid() == 0:
        for path in (*sorted(fresh.rglob("*"), reverse=True), fresh):
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)
    fresh.chmod(owner.st_mode & 0o7777)


def _locked(path: Path) -> bool:
    """Whether the process whose lock this is runs."""
    try:
        with path.open() as file:  # never made here: it would be of another owner
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _is_open(path: Path) -> bool:
    """Whether a process that we may look at has the file open."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            if link.readlink() == path.absolute():
                return True
    return False


def _holds_data(folder: Path) -> bool:
    return any(path.is_file() and path.suffix != ".lock" and path.name != STATE for path in folder.rglob("*"))
