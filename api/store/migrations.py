"""Create or upgrade the tables of the database; `migrate` runs at each start of the service.

The revisions are Alembic scripts in `revisions/versions`; docs/decisions/0009-alembic.md says how to add one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, inspect

from stimrig.api.store import copies
from stimrig.api.store.tables import Table

REVISIONS = Path(__file__).parent / "revisions"
BEFORE = "before-upgrade"
"""Folder beside a SQLite database for the copies that are made before an upgrade."""


class SchemaError(Exception):
    """The database cannot be used by this version."""


def migrate(engine: Engine) -> None:
    """Bring the tables to the newest revision in one transaction; a SQLite file is copied before.

    Raises SchemaError: the database is newer than the software, its columns do not fit, or it cannot be copied.
    """
    config = Config()
    config.set_main_option("script_location", str(REVISIONS).replace("%", "%%"))
    scripts = ScriptDirectory.from_config(config)
    newest = scripts.get_current_head()
    with engine.connect() as connection:
        current = MigrationContext.configure(connection).get_current_revision()
        if current == newest:
            refuse_incomplete(connection)
            return
    if current is not None and current not in {script.revision for script in scripts.walk_revisions()}:
        raise SchemaError(
            f"it is of version {current}, this stimrig knows versions up to {newest}; "
            "install the stimrig that wrote it, or set STIMRIG_DATA_DIR to another folder"
        )
    with copied_before(engine.url.database, current), engine.begin() as writer:
        config.attributes["connection"] = writer
        command.upgrade(config, "head")
        refuse_incomplete(writer)


@contextmanager
def copied_before(database: str | None, current: str | None) -> Iterator[None]:
    """Keep a copy of a SQLite file; it is removed again if the upgrade fails, which leaves the database unchanged.

    Nothing is copied where there is no file with tables yet, and of a PostgreSQL database: pg_dump makes its backups.

    Raises SchemaError: no copy can be made.
    """
    path = Path(database or "")
    if current is None or not path.is_file():
        yield
        return
    names = (path.parent / BEFORE / f"{path.stem}-{current}-{number}.db" for number in count(1))
    copy = next(name for name in names if not name.exists())
    try:
        copies.copy_database(path, copy)
    except copies.CopyError as error:
        raise SchemaError(f"it is of version {current} and is upgraded only with a copy: {error}") from error
    try:
        yield
    except BaseException:
        copy.unlink()
        raise


def refuse_incomplete(connection: Connection) -> None:
    """Raise SchemaError if a column of `stimrig.api.store.tables` is missing, or an unknown one refuses new rows."""
    inspected = inspect(connection).get_multi_columns()
    existing = {f"{table}.{column['name']}": column for (_, table), columns in inspected.items() for column in columns}
    expected = [str(column) for table in Table.metadata.sorted_tables for column in table.columns]
    if missing := [column for column in expected if column not in existing]:
        raise SchemaError(f"there is no column {missing[0]}; restore the database from a backup")
    for name, column in existing.items():
        if name in expected or name.split(".")[0] not in Table.metadata.tables:
            continue
        if not column["nullable"] and column["default"] is None:
            raise SchemaError(
                f"the column {name} is of another stimrig and refuses new rows; "
                "install the stimrig that wrote it, or set STIMRIG_DATA_DIR to another folder"
            )
