"""A copy of a SQLite database: one consistent state, whole or not there, also while a service writes."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from stimrig.api import owner_only
from stimrig.api.whole_file import sha256_of, whole_path


class CopyError(OSError):
    """The copy could not be made, or does not hold; one line."""


def copy_database(source: Path, to: Path) -> str:
    """Copy a database by SQLite's own backup, check the copy and bring it to the disk; its SHA-256.

    Raises CopyError: there is no room, or what was copied is damaged. Nothing is left then.
    """
    try:
        owner_only.folder(to.parent)
        with whole_path(to) as part:
            part.unlink(missing_ok=True)
            owner_only.file(part)
            with (
                closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True, timeout=10)) as old,
                closing(sqlite3.connect(part)) as new,
            ):
                old.backup(new)
                new.execute("PRAGMA journal_mode=DELETE")
                answer = new.execute("PRAGMA quick_check").fetchone()[0]
            if answer != "ok":
                raise CopyError(f"{source}: damaged ({answer}); restore it from a backup")
    except CopyError:
        raise
    except (OSError, sqlite3.Error) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise CopyError(f"{to}: no copy of the database could be made ({why}); free some disk space") from error
    return sha256_of(to)
