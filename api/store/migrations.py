"""From an older database to today's, one step at a time; a newer one is left alone, and said so.

The version is kept in the database itself. A database without one is from before versions were kept, or new: what it
lacks is added. A step only ever adds; the rows that are there stay as they are, the audit trail above all.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Column, Connection, Engine, inspect, text

from api.store import tables

VERSION = 4
"""Raised whenever a table changes; the step that brings an older database there goes into `STEPS`."""


class SchemaError(Exception):
    """The database is not one that this version can use."""


def bring_up(engine: Engine) -> int:
    """Make or upgrade the tables; the version found (0: none was kept).

    Raises
    ------
    SchemaError
        The database is newer than the software, or holds a table that it cannot be brought from.
    """
    with engine.begin() as connection:
        tables.SchemaVersion.metadata.tables["schema_version"].create(connection, checkfirst=True)
        kept = connection.execute(text("SELECT MAX(version) FROM schema_version")).scalar()
        found = 0 if kept is None else int(kept)
        if found > VERSION:
            mend = "install the stimrig that wrote it, or set STIMRIG_DATA_DIR to another folder"
            raise SchemaError(f"it is of version {found}, this stimrig knows versions up to {VERSION}; {mend}")
        for number in range(found + 1, VERSION + 1):
            STEPS[number](connection)
        if found < VERSION:
            connection.execute(text("INSERT INTO schema_version (version) VALUES (:version)"), {"version": VERSION})
    return found


def make_tables(connection: Connection) -> None:
    """1, 3: the tables, where they are not there; the places that people sign in from came with 3."""
    tables.Table.metadata.create_all(connection)


def add_columns(connection: Connection) -> None:
    """2, 4: columns that older tables lack, such as the end of an approval; an upload's warnings came with 4."""
    seen = inspect(connection)
    for table in tables.Table.metadata.sorted_tables:
        if not seen.has_table(table.name):
            continue  # a later step makes it
        there = {column["name"] for column in seen.get_columns(table.name)}
        for column in table.columns:
            if column.name not in there:
                _add(connection, table.name, column)


def _add(connection: Connection, table: str, column: Column[object]) -> None:
    if not column.nullable:
        raise SchemaError(
            f"table {table} lacks {column.name}, which cannot be made up; restore the database from a backup"
        )
    kind = column.type.compile(connection.dialect)
    connection.execute(text(f"ALTER TABLE {table} ADD COLUMN {column.name} {kind}"))


STEPS: dict[int, Callable[[Connection], None]] = {1: make_tables, 2: add_columns, 3: make_tables, 4: add_columns}
