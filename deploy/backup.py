#!/usr/bin/env python3
"""Backup of stimrig's database and recordings, its check, and the way back. Standard library only.

    backup.py make --to FOLDER        a checked copy, also while a test runs
    backup.py verify BACKUP           every checksum, and the database's own integrity
    backup.py restore BACKUP          into empty data folders; --force sets what is there aside, deletes nothing

Exit 0: done. 1: a check failed, nothing was restored. 2: a mistake in the arguments, one line.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

RIG_DATA = Path("/var/lib/stimrig/rig")
API_DATA = Path("/var/lib/stimrig/api")
MANIFEST = "manifest.json"
DATABASE = "api/stimrig.db"
MARGIN_BYTES = 64 * 2**20


class BackupError(Exception):
    """What is wrong, where, and how to fix it; `code` is the exit code."""

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = code


def make(rig_data: Path, api_data: Path, to: Path) -> Path:
    """Copy everything that cannot be made again into a new folder below `to`.

    The database is copied first, then journals, then recordings: what the database names is then in the copy, and a
    test that ends meanwhile is in it as a journal, as a recording, or as both.

    Raises BackupError: no database, no room, or the copy does not hold; a partial copy keeps the suffix `.partial`.
    """
    source = api_data / "stimrig.db"
    if not source.is_file():
        raise BackupError(f"{source}: no database; give the service's data folder with --api-data", 2)
    need = MARGIN_BYTES + source.stat().st_size + sum(path.stat().st_size for path, _ in _kept(rig_data, api_data))
    to.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(to).free
    if free < need:
        raise BackupError(f"{to}: {free // 2**20} MB free, {need // 2**20} MB needed; move old backups away")
    name = f"stimrig-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
    partial = to / f"{name}.partial"
    partial.mkdir(mode=0o700)
    (partial / "api").mkdir()
    _copy_database(source, partial / DATABASE)
    for path, name_inside in _kept(rig_data, api_data):
        _copy(path, partial / name_inside)
    if (rig_data / "latch.json").is_file():
        _copy(rig_data / "latch.json", partial / "rig" / "latch.json")
    sums = {str(path.relative_to(partial)): _sha256(path) for path in sorted(partial.rglob("*")) if path.is_file()}
    content = {"format": 1, "created_utc": datetime.now(UTC).isoformat(timespec="seconds"), "sha256": sums}
    _write(partial / MANIFEST, json.dumps(content, indent=1).encode())
    verify(partial)
    done = to / name
    partial.rename(done)
    _sync(to)
    return done


def verify(backup: Path) -> dict[str, int]:
    """Check a backup: every file, none too many, the database, and that each recording it names is there unchanged.

    Raises BackupError: what does not hold.
    """
    sums = _manifest(backup)
    present = {str(path.relative_to(backup)) for path in backup.rglob("*") if path.is_file()} - {MANIFEST}
    wrong = sorted(name for name in sums.keys() & present if _sha256(backup / name) != sums[name])
    for what, names in (
        ("missing", sorted(sums.keys() - present)), ("unknown", sorted(present - sums.keys())), ("changed", wrong)
    ):  # fmt: skip
        if names:
            raise BackupError(f"{backup}: {what}: {', '.join(names[:5])}{' …' if len(names) > 5 else ''}")
    recordings = {Path(name).name: digest for name, digest in sums.items() if "/recordings/" in name}
    with closing(_read_only(backup / DATABASE)) as database:
        answer = database.execute("PRAGMA integrity_check").fetchone()[0]
        if answer != "ok":
            raise BackupError(f"{backup / DATABASE}: {answer}")
        named = database.execute("SELECT path, file_sha256 FROM recordings WHERE path != ''").fetchall()
    for path, digest in named:
        found = recordings.get(Path(path).name)
        if found != digest:
            state = "is not in the backup" if found is None else "differs from what the database says"
            raise BackupError(f"{backup}: recording {Path(path).name} {state}")
    return {"files": len(sums), "recordings": len(recordings), "named_in_database": len(named)}


def restore(backup: Path, rig_data: Path, api_data: Path, force: bool) -> list[str]:
    """Put a backup back; what happened, in words. The rig comes up latched: a person looks first.

    Raises BackupError: the backup does not hold, a process uses the data, or there are data and no `force`. Nothing was
    touched.
    """
    verify(backup)
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
    _stage(backup / "rig", fresh[rig_data], ("journals", "recordings"))
    _stage(backup / "api", fresh[api_data], ("recordings/rig",) if api_data != rig_data else ())
    _latch(fresh[rig_data] / "latch.json", f"the data were restored from {backup.name}")
    _check_copy(backup, fresh[rig_data], fresh[api_data])
    return [words for target in targets for words in _replace(target, fresh[target])]


def _stage(source: Path, fresh: Path, folders: tuple[str, ...]) -> None:
    fresh.mkdir(parents=True, exist_ok=True, mode=0o700)
    sealed = {path.stem.partition("Z_")[2] for path in (source / "recordings").glob("*.h5")}
    for path in sorted(source.rglob("*")):
        if path.is_file() and not (path.suffix == ".journal" and path.stem in sealed):  # it ended during the backup
            _copy(path, fresh / path.relative_to(source))
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
        _write(path, json.dumps({"state": "latched", "reason": reason}).encode())


def _replace(target: Path, fresh: Path) -> Iterator[str]:
    _own_like(fresh, target)
    if _holds_data(target):
        aside = target.with_name(f"{target.name}.before-{datetime.now(UTC):%Y%m%dT%H%M%SZ}")
        target.rename(aside)
        yield f"{target}: what was there is now in {aside}"
    elif target.exists():
        shutil.rmtree(target)
    fresh.rename(target)
    _sync(target.parent)
    yield f"{target}: restored"


def _check_copy(backup: Path, rig: Path, api: Path) -> None:
    for name, digest in _manifest(backup).items():
        label, _, rest = name.partition("/")
        path = (rig if label == "rig" else api) / rest
        if path.suffix == ".journal" and not path.exists():
            continue
        if rest != "latch.json" and _sha256(path) != digest:
            raise BackupError(f"{path}: differs from the backup; is the disk sound? Nothing was replaced")


def _own_like(fresh: Path, target: Path) -> None:
    """The owner and mode that the data folder had: as root only, else they stay the caller's."""
    if not target.exists():
        return
    owner = target.stat()
    fresh.chmod(owner.st_mode & 0o7777)
    if os.geteuid() == 0:
        for path in (fresh, *fresh.rglob("*")):
            os.chown(path, owner.st_uid, owner.st_gid)


def _copy_database(source: Path, target: Path) -> None:
    """SQLite's own backup: one consistent state, also while the service writes."""
    with closing(_read_only(source)) as old, closing(sqlite3.connect(target)) as new:
        old.backup(new)
        new.execute("PRAGMA journal_mode=DELETE")


def _read_only(path: Path) -> sqlite3.Connection:
    try:
        return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10)
    except sqlite3.Error as error:
        raise BackupError(f"{path}: {error}") from None


def _kept(rig_data: Path, api_data: Path) -> Iterator[tuple[Path, Path]]:
    """What is copied beside the database, and its name in the backup: journals first, since they become recordings.

    One folder for both (`stimrig serve`) counts as the rig's. `rig` in the service's recordings is the rig's own.
    """
    places = [(rig_data, "rig", "journals", ""), (rig_data, "rig", "recordings", "")]
    if api_data.resolve() != rig_data.resolve():
        places.append((api_data, "api", "recordings", "rig"))
    for root, label, folder, skip in places:
        for path in sorted((root / folder).rglob("*")):
            inside = path.relative_to(root / folder).parts
            if path.is_file() and not path.is_symlink() and not path.name.startswith(".") and inside[0] != skip:
                yield path, Path(label) / path.relative_to(root)


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
    try:
        with source.open("rb") as old, target.open("xb") as new:
            shutil.copyfileobj(old, new, 2**20)
            new.flush()
            os.fsync(new.fileno())
    except FileNotFoundError:
        if source.suffix != ".journal":  # one that was sealed meanwhile: its recording follows
            raise
        return
    target.chmod(0o640)


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    path.chmod(0o640)


def _sync(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY)
    os.fsync(fd)
    os.close(fd)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _manifest(backup: Path) -> dict[str, str]:
    try:
        content = json.loads((backup / MANIFEST).read_text("utf-8"))
        sums = {str(name): str(digest) for name, digest in content["sha256"].items()}
    except FileNotFoundError:
        raise BackupError(f"{backup}: no {MANIFEST}; not a backup, or one that was cut short", 2) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BackupError(f"{backup / MANIFEST}: cannot be read ({error})") from None
    if content.get("format") != 1 or DATABASE not in sums:
        raise BackupError(f"{backup / MANIFEST}: not a backup of this format")
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in sums):
        raise BackupError(f"{backup / MANIFEST}: names a file outside the backup")
    return sums


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
    return any(path.is_file() and path.suffix != ".lock" for path in folder.rglob("*"))


def main(arguments: list[str] | None = None) -> int:
    """Run a verb; the exit code."""
    parser = argparse.ArgumentParser(prog="backup.py", description=(__doc__ or "").partition("\n")[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    folders = argparse.ArgumentParser(add_help=False)
    folders.add_argument("--rig-data", type=Path, default=RIG_DATA, help=f"default {RIG_DATA}")
    folders.add_argument("--api-data", type=Path, default=API_DATA, help=f"default {API_DATA}")
    verbs.add_parser("make", parents=[folders]).add_argument("--to", type=Path, required=True, metavar="FOLDER")
    verbs.add_parser("verify").add_argument("backup", type=Path)
    back = verbs.add_parser("restore", parents=[folders])
    back.add_argument("backup", type=Path)
    back.add_argument("--force", action="store_true", help="where data are: set them aside, then restore")
    options = parser.parse_args(arguments)
    try:
        if options.verb == "make":
            done = make(options.rig_data, options.api_data, options.to)
            print(json.dumps({"backup": str(done), **verify(done)}))
        elif options.verb == "verify":
            print(json.dumps(verify(options.backup)))
        else:
            print("\n".join(restore(options.backup, options.rig_data, options.api_data, options.force)))
    except BackupError as error:
        print(f"backup.py: {error}", file=sys.stderr)
        return error.code
    except (OSError, sqlite3.Error) as error:
        print(f"backup.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
