"""A backup is restored into a new place and looked at, as after the loss of a machine; then the place is removed."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stimrig.api.operation.backup import recordings_named
from stimrig.api.operation.copying import (
    BackupError,
    Meter,
    manifest,
    read_only,
    refuse_no_room,
    row_counts,
    size_of,
)  # fmt: skip
from stimrig.api.operation.restore import restore
from stimrig.api.whole_file import sha256_of

PREFIX = ".restored-"
READS = 3
"""How often each byte is read: to check the backup, to copy it, to check the copy."""


@dataclass(frozen=True)
class Drill:
    """What was found in what was restored."""

    created_utc: str
    bytes: int
    files_same: int
    """Restored files with the SHA-256 of the manifest."""
    rows: int
    rows_compared: bool
    """False: the backup is older than the numbers of rows in manifests."""
    recordings: int
    """That the database names: each was there, had its hash and could be opened."""
    models: int
    """Each had its hash and was read."""
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """As one object."""
        return asdict(self)


def verify(backup: Path, place: Path | None = None, tell: Callable[[float, str], None] | None = None) -> Drill:
    """Restore a backup below `place` (default: beside it), compare everything, and remove what was restored.

    Raises BackupError: what does not hold, or there is no room.
    """
    began_s, told, need = time.monotonic(), manifest(backup), size_of(backup)
    place = place or backup.absolute().parent
    for left in place.glob(f"{PREFIX}*"):
        raise BackupError(f"{left}: of another check, which runs or was cut short; if none runs, remove it", 2)
    refuse_no_room(place, need, "give a folder on another disk with --place", 2)
    meter = Meter(tell or (lambda _share, _text: None), READS * need)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=place))
    try:
        rig, api = folder / "rig", folder / "api"
        same = restore(backup, rig, api, force=False, meter=meter).files_same
        database = api / "stimrig.db"
        recordings = _open_recordings(database, rig, api)
        rows = _compare_rows(database, told["rows"])
        models = _load_models(database)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    seconds = round(time.monotonic() - began_s, 1)
    return Drill(told["created_utc"], need, same, rows, bool(told["rows"]), recordings, models, seconds)


def _compare_rows(database: Path, told: dict[str, int]) -> int:
    """All rows there are. Raises BackupError where a table has another number than the manifest says."""
    found = row_counts(database)
    for table in sorted(told.keys() | found.keys()) if told else ():
        if told.get(table) != found.get(table):
            raise BackupError(f"{database.name}: {table}: {found.get(table)} rows, the backup had {told.get(table)}")
    return sum(found.values())


def _open_recordings(database: Path, rig: Path, api: Path) -> int:
    """How many recordings the database names. Raises BackupError: one is missing, another one, or does not open."""
    import h5py

    there = {path.name: path for root in (rig, api) for path in (root / "recordings").rglob("*") if path.is_file()}
    named = recordings_named(database)
    for name, digest in ((Path(path).name, digest) for path, digest in named):
        if name not in there:
            raise BackupError(f"recording {name}: the database names it, and it was not restored")
        if sha256_of(there[name]) != digest:
            raise BackupError(f"recording {name}: differs from what the database says")
        if there[name].suffix in (".h5", ".hdf5"):
            try:
                with h5py.File(there[name]) as file:
                    file.visititems(lambda _name, _item: None)
            except OSError as error:
                raise BackupError(f"recording {name}: cannot be opened ({error})") from None
    return len(named)


def _load_models(database: Path) -> int:
    """How many models there are. Raises BackupError: one is damaged, or cannot be read."""
    from stimrig import identify
    from stimrig.api.models import stored_model
    from stimrig.api.store.tables import Model
    from stimrig.identify import muscles

    with closing(read_only(database)) as opened:
        if not opened.execute("SELECT 1 FROM sqlite_master WHERE name = 'models'").fetchone():
            return 0
        rows = opened.execute("SELECT id, method, etag, document FROM models").fetchall()
    for model_id, method, etag, document in rows:
        row = Model(id=model_id, method=method, etag=etag, document=document)
        reader = muscles.JointModel if method == stored_model.JOINT else identify.Model
        try:
            reader.from_json(stored_model.text(row))
        except Exception as error:  # whatever is wrong with it: it would be of no use
            raise BackupError(f"model {model_id}: cannot be read ({error})") from error
    return len(rows)
