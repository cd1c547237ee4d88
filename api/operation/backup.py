"""A backup of a rig's database and recordings: made while a test runs, and checked. SQLite only, and nothing but it."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from stimrig.api.operation.copying import (
    DATABASE,
    MANIFEST,
    NO_METER,
    BackupError,
    Meter,
    copy,
    manifest,
    read_only,
    refuse_no_room,
    row_counts,
    write,
)
from stimrig.api.store.copies import copy_database
from stimrig.api.whole_file import sha256_of, to_disk


def create(rig_data: Path, api_data: Path, to: Path, tell: Callable[[float, str], None] | None = None) -> Path:
    """Copy everything that cannot be made again into a new folder below `to`; `tell` hears how far it is.

    The database is copied first, then journals, then recordings: what the database names is then in the copy, and a
    test that ends meanwhile is in it as a journal, as a recording, or as both.

    Raises BackupError: no database, no room, or the copy does not hold; a partial copy keeps the suffix `.partial`.
    """
    source = api_data / "stimrig.db"
    if not source.is_file():
        raise BackupError(f"{source}: no database; give the service's data folder with --data", 2)
    need = source.stat().st_size + sum(path.stat().st_size for path, _ in _kept(rig_data, api_data))
    meter = Meter(tell, 3 * need) if tell else NO_METER
    to.mkdir(parents=True, exist_ok=True)
    refuse_no_room(to, need, "move old backups away")
    name = f"stimrig-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
    partial = to / f"{name}.partial"
    partial.mkdir(mode=0o700)
    (partial / "api").mkdir()
    meter.add(source, "copies")
    copy_database(source, partial / DATABASE)
    for path, name_inside in _kept(rig_data, api_data):
        meter.add(path, "copies")
        copy(path, partial / name_inside)
    if (rig_data / "latch.json").is_file():
        copy(rig_data / "latch.json", partial / "rig" / "latch.json")
    write(partial / MANIFEST, json.dumps(_content(partial, meter), indent=1).encode())
    check(partial, meter)
    done = to / name
    partial.rename(done)
    to_disk(to)
    return done


def _content(partial: Path, meter: Meter) -> dict[str, object]:
    """What the manifest says of the files that are there."""
    sums = {}
    for path in sorted(partial.rglob("*")):
        if path.is_file():
            meter.add(path, "reads")
            sums[str(path.relative_to(partial))] = sha256_of(path)
    created, rows = datetime.now(UTC).isoformat(timespec="seconds"), row_counts(partial / DATABASE)
    return {"format": 1, "created_utc": created, "rows": rows, "sha256": sums}


def check(backup: Path, meter: Meter = NO_METER) -> dict[str, int]:
    """Check a backup: every file, none too many, the database, and that each recording it names is there unchanged.

    Raises BackupError: what does not hold.
    """
    sums = manifest(backup)["sha256"]
    present = {str(path.relative_to(backup)) for path in backup.rglob("*") if path.is_file()} - {MANIFEST}
    wrong = []
    for name in sorted(sums.keys() & present):
        meter.add(backup / name, "checks")
        wrong += [name] if sha256_of(backup / name) != sums[name] else []
    for what, names in (
        ("missing", sorted(sums.keys() - present)), ("unknown", sorted(present - sums.keys())), ("changed", wrong)
    ):  # fmt: skip
        if names:
            raise BackupError(f"{backup}: {what}: {', '.join(names[:5])}{' …' if len(names) > 5 else ''}")
    recordings = {Path(name).name: digest for name, digest in sums.items() if "/recordings/" in name}
    named = recordings_named(backup / DATABASE)
    for path, digest in named:
        found = recordings.get(Path(path).name)
        if found != digest:
            state = "is not in the backup" if found is None else "differs from what the database says"
            raise BackupError(f"{backup}: recording {Path(path).name} {state}")
    return {"files": len(sums), "recordings": len(recordings), "named_in_database": len(named)}


def recordings_named(database: Path) -> list[tuple[str, str]]:
    """Place and SHA-256 of each recording that a database names. Raises BackupError: it is damaged."""
    with closing(read_only(database)) as opened:
        try:
            answer = opened.execute("PRAGMA integrity_check").fetchone()[0]
        except sqlite3.DatabaseError as error:
            answer = str(error)
        if answer != "ok":
            raise BackupError(f"{database}: {answer}")
        return opened.execute("SELECT path, file_sha256 FROM recordings WHERE path != ''").fetchall()


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
