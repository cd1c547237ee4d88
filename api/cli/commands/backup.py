"""`stimrig backup`: copy the database, the recordings and the journals into one folder, with checked hashes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.engine import make_url

from stimrig.api.cli.commands.audit import DataDir, settings_of
from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.options import Json, RigData
from stimrig.api.cli.terminal import report
from stimrig.api.store.copies import copy_database
from stimrig.api.store.database import sqlite_file
from stimrig.api.whole_file import sha256_of, to_disk

DATABASE, SUMS = "api/stimrig.db", "SHA256SUMS"


def backup(
    to: Annotated[Path, typer.Argument(help="folder for backups, best on another disk", metavar="FOLDER")],
    data: DataDir = None,
    rig_data: RigData = None,
    as_json: Json = False,
) -> None:
    """Copy database, recordings and journals into a new folder below FOLDER, and check it; also while a test runs."""
    settings = settings_of(data)
    database = sqlite_file(make_url(settings.database))
    if database is not None and not database.is_file():
        raise InputError(f"{database}: there is no database. Give the data folder with --data.")
    created = to / f"stimrig-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
    partial = created.with_name(f"{created.name}.partial")
    try:
        to.mkdir(parents=True, exist_ok=True)
        partial.mkdir(mode=0o700)
        # the database first: every file that it names exists by then and is copied afterwards
        sums = {} if database is None else {DATABASE: copy_database(database, partial / DATABASE)}
        sums |= copy_files(partial, rig_data or settings.data_dir, settings.data_dir)
        damaged = [] if database is None else damaged_recordings(partial / DATABASE, sums)
        (partial / SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())), "utf-8")
        to_disk(partial / SUMS)
        partial.rename(created)
        to_disk(to)
    except (OSError, sqlite3.Error) as error:
        shutil.rmtree(partial, ignore_errors=True)
        raise CommandError(f"{error}. No backup was made.") from error
    size = sum((created / name).stat().st_size for name in sums)
    document = {"backup": str(created), "files": len(sums), "bytes": size, "database": database is not None}
    words = f"{created}: {len(sums)} files, {size / 1e6:.1f} MB; `sha256sum --check {SUMS}` checks them again"
    dump = "The database is not in it. Before each backup of the files make a dump: pg_dump --format=custom"
    report(document | {"damaged": damaged}, as_json, words, *([dump] if database is None else []))
    if damaged:
        raise CommandError(f"{'; '.join(damaged)}. All else is saved. Restore the recording from an earlier backup.")


def copy_files(target: Path, rig_data: Path, api_data: Path) -> dict[str, str]:
    """Copy journals, recordings and the latch; return the SHA-256 of each by its name in the backup.

    Recordings are looked for after the journals were copied, so a test that ends meanwhile is not lost. One folder for
    rig and service counts as the rig's; `recordings/rig` of the service is the rig's own folder, mounted there.
    """
    places = [(rig_data, "rig", "journals"), (rig_data, "rig", "recordings")]
    places += [(api_data, "api", "recordings")] if api_data.resolve() != rig_data.resolve() else []
    sums = {}
    for root, label, folder in places:
        for path in sorted((root / folder).rglob("*")):
            name = label / path.relative_to(root)
            if path.is_symlink() or path.name.startswith(".") or name.parts[:3] == ("api", "recordings", "rig"):
                continue  # a hidden file is still being written
            with contextlib.suppress(FileNotFoundError) if folder == "journals" else contextlib.nullcontext():
                if path.is_file():
                    sums[str(name)] = write(target / name, path.read_bytes())
    sealed = {Path(name).stem.partition("Z_")[2] for name in sums if "/recordings/" in name}
    for name in [name for name in sums if "/journals/" in name and Path(name).stem in sealed]:
        (target / name).unlink()
        del sums[name]
    latch = rig_data / "latch.json"
    content = latch.read_bytes() if latch.is_file() else b'{"state": "latched"}'
    if b'"latched"' in content:  # from any other state the rig starts as uncertain, which is stricter
        content = json.dumps({"state": "latched", "reason": f"the data were restored from {target.stem}"}).encode()
    return sums | {"rig/latch.json": write(target / "rig/latch.json", content)}


def write(path: Path, content: bytes) -> str:
    """Write a file to the disk, read it again and return its SHA-256. Raises OSError: it is another one."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.write_bytes(content)
    to_disk(path)
    if (digest := sha256_of(path)) != hashlib.sha256(content).hexdigest():
        raise OSError(f"{path}: differs from what was written; is the disk sound?")
    return digest


def damaged_recordings(database: Path, sums: dict[str, str]) -> list[str]:
    """Return a line for each recording that is not in the backup as the database knows it."""
    copied = {Path(name).name: digest for name, digest in sums.items()}
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as opened:
        rows = opened.execute("SELECT path, file_sha256 FROM recordings").fetchall()
    return [
        f"{path}: the recording {'differs from what the database says' if Path(path).name in copied else 'is missing'}"
        for path, digest in rows
        if copied.get(Path(path).name) != digest
    ]
