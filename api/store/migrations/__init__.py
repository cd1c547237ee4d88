"""From an older database to today's by Alembic's revisions, in one transaction. A newer database is left alone.

Each change of a table is one file in `versions`; docs/decisions/0009-alembic.md says how to add one. Databases from
before Alembic kept a number in the table `schema_version`: they are taken over at the revision of that number.
"""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, Engine, inspect, text

from stimrig.api.store import centre_tables
from stimrig.api.store.engines import WRITES

FOLDER = Path(__file__).parent
METADATA = centre_tables.Table.metadata
"""Of all tables: the centre's, too."""
NUMBERED = {0: "0001", 1: "0001", 2: "0002", 3: "0003", 4: "0004"}
"""The revision of each number in `schema_version`; 0: tables, but no number yet."""
SCRIPTS = ScriptDirectory(str(FOLDER))
NEWEST = SCRIPTS.get_current_head()


class SchemaError(Exception):
    """The database is not one that this version can use."""


def bring_up(engine: Engine) -> None:
    """Make or upgrade the tables; all of it is done, or nothing.

    Raises
    ------
    SchemaError
        The database is newer than the software, or lacks a column that no revision adds.
    """
    with engine.connect() as connection:
        at = MigrationContext.configure(connection).get_current_revision()
        connection.rollback()
        if at != NEWEST:
            with engine.execution_options(**WRITES).begin() as writer:  # one service at a time, and only once
                _upgrade(writer)
                _refuse_lacking(writer)
        else:
            _refuse_lacking(connection)


def _upgrade(connection: Connection) -> None:
    context = MigrationContext.configure(connection)
    kept = context.get_current_revision()
    if kept is None and (kept := _numbered(connection)) is not None:
        context.stamp(SCRIPTS, kept)
    elif kept is not None and kept not in {script.revision for script in SCRIPTS.walk_revisions()}:
        raise _newer(kept)
    config = Config()
    config.set_main_option("script_location", str(FOLDER).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _numbered(connection: Connection) -> str | None:
    """The revision at which a database from before Alembic stands; None for a new one."""
    seen = inspect(connection)
    if not seen.has_table("participants"):
        return None
    number = 0
    if seen.has_table("schema_version"):
        number = connection.execute(text("SELECT MAX(version) FROM schema_version")).scalar() or 0
    if number not in NUMBERED:
        raise _newer(number)
    return NUMBERED[number]


def _newer(found: object) -> SchemaError:
    fix = "install the stimrig that wrote it, or set STIMRIG_DATA_DIR to another folder"
    return SchemaError(f"it is of version {found}, this stimrig knows versions up to {NEWEST}; {fix}")


def _refuse_lacking(connection: Connection) -> None:
    """Compare the database's columns with those of `stimrig.api.store.tables`."""
    found = inspect(connection).get_multi_columns()
    kept = {table: {column["name"] for column in columns} for (_, table), columns in found.items()}
    for table in METADATA.sorted_tables:
        if table.name not in kept:
            lacking = f"there is no table {table.name}"
        elif missing := [column.name for column in table.columns if column.name not in kept[table.name]]:
            lacking = f"table {table.name} lacks {missing[0]}"
        else:
            continue
        raise SchemaError(f"{lacking}, which cannot be made up; restore the database from a backup")
