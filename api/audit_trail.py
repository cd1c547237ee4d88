"""The audit trail as it is stored, and as an exported file holds it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from api.errors import ApiError
from api.settings import Settings
from api.store import Store
from api.store.tables import AuditEntry
from api.terminal import InputError


def stored(data: Path | None) -> list[AuditEntry]:
    """The trail in the database, read only.

    Raises
    ------
    InputError
        There is no database.
    """
    given: dict[str, Any] = {} if data is None else {"data_dir": data}
    settings = Settings(**given)
    if settings.database_url is None and not (settings.data_dir / "stimrig.db").is_file():
        raise InputError(f"{settings.data_dir / 'stimrig.db'}: there is no database. Give the data folder with --data.")
    try:
        store = Store(settings.database)
    except ApiError as error:
        raise InputError(str(error)) from error
    try:
        return store.all(AuditEntry, order=AuditEntry.seq)
    finally:
        store.close()


def read_export(path: Path) -> list[AuditEntry]:
    """An exported trail.

    Raises
    ------
    InputError
        The file cannot be read, or a line is no entry.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}. Give a file written by `stimrig audit export`.") from error
    columns = {column.name for column in AuditEntry.__table__.columns}
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            fields = json.loads(line)
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}: no JSON. Give a file written by `stimrig audit export`."
            ) from error
        if not isinstance(fields, dict) or set(fields) != columns:
            raise InputError(f"{path}, line {number}: no entry of an audit trail.")
        entries.append(AuditEntry(**fields))
    return entries
