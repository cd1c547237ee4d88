"""What an older version cannot hold, kept in the table `set_aside` of the same database until a newer one has it.

An older version neither reads nor changes this table. Content is JSON; bytes are written as base64.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Connection

SET_ASIDE = sa.Table(
    "set_aside",
    sa.MetaData(),
    sa.Column("id", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("revision", sa.String, nullable=False),
    sa.Column("of_table", sa.String, nullable=False),
    sa.Column("row_key", sa.Text, nullable=False),
    sa.Column("content", sa.Text, nullable=False),
    sa.Column("unless_changed", sa.Text, nullable=False),
    sa.Column("why", sa.Text, nullable=False),
)
"""A row for each row, or part of one. `unless_changed`: columns that must still be so when it comes back."""


class Shelf:
    """What the way back from one revision sets aside.

    `why` of each: a sentence for people that begins with what it is.
    """

    def __init__(self, connection: Connection, revision: str) -> None:
        self.connection, self._revision = connection, revision
        SET_ASIDE.create(connection, checkfirst=True)

    def columns(
        self, table: str, names: Iterable[str], why: str, only: Callable[[Any], bool] | None = None,
        unless_changed: Iterable[str] = (),
    ) -> None:  # fmt: skip
        """Keep these columns of each row that is wanted; without `only`, in which one of them has a value."""
        held, wanted = reflected(self.connection, table), list(names)
        for row in self.connection.execute(sa.select(held)).mappings().all():
            if only(row) if only else any(row[name] is not None for name in wanted):
                guard = {name: row[name] for name in unless_changed}
                self.keep(held, row, {name: row[name] for name in wanted}, why, guard)

    def rows(self, table: str, why: str) -> None:
        """Keep all rows of a table that goes."""
        held = reflected(self.connection, table)
        for row in self.connection.execute(sa.select(held)).mappings().all():
            self.keep(held, row, dict(row), why, {})

    def replace(self, table: str, row: Mapping[Any, Any], new: Mapping[str, Any], why: str) -> None:
        """Give a row other values while the older version has it; if it leaves them so, the old ones come back."""
        held = reflected(self.connection, table)
        self.keep(held, row, {name: row[name] for name in new}, why, new)
        self.connection.execute(held.update().where(*_at(held, _key(held, row))).values(**new))

    def keep(
        self, held: sa.Table, row: Mapping[Any, Any], content: Mapping[str, Any], why: str, guard: Mapping[str, Any]
    ) -> None:
        """Write it down."""
        texts = {"row_key": _text(_key(held, row)), "content": _text(content), "unless_changed": _text(guard)}
        values = {"revision": self._revision, "of_table": held.name, "why": why} | texts
        self.connection.execute(SET_ASIDE.insert().values(**values))


def bring_back(connection: Connection, revision: str) -> list[str]:
    """Put in what was set aside on the way back from this revision; a line for what has to stay aside."""
    if not sa.inspect(connection).has_table(SET_ASIDE.name):
        return []
    query = sa.select(SET_ASIDE).where(SET_ASIDE.c.revision == revision).order_by(SET_ASIDE.c.id)
    stays: dict[str, int] = {}
    tables: dict[str, sa.Table] = {}
    for row in connection.execute(query).mappings().all():
        name = row["of_table"]
        held = tables[name] = tables[name] if name in tables else reflected(connection, name)
        if _put(connection, held, row):
            connection.execute(SET_ASIDE.delete().where(SET_ASIDE.c.id == row["id"]))
        else:
            stays[row["why"]] = stays.get(row["why"], 0) + 1
    return [f"{count} × {why} It stays aside: what it belongs to was changed since." for why, count in stays.items()]


def forget(connection: Connection, names: Iterable[str]) -> None:
    """Delete what is aside and names one of these: a participant's code, the ids of what was theirs."""
    if sa.inspect(connection).has_table(SET_ASIDE.name):
        wanted = [f'"{name}"' for name in names]
        for row in connection.execute(sa.select(SET_ASIDE)).mappings().all():
            if any(name in row["row_key"] or name in row["content"] for name in wanted):
                connection.execute(SET_ASIDE.delete().where(SET_ASIDE.c.id == row["id"]))


def told(connection: Connection) -> list[str]:
    """A line for each kind of thing that is aside."""
    counted = (
        sa.select(SET_ASIDE.c.why, sa.func.count()).group_by(SET_ASIDE.c.why).order_by(sa.func.min(SET_ASIDE.c.id))
    )
    return [f"{count} × {why}" for why, count in connection.execute(counted)]


def reflected(connection: Connection, table: str) -> sa.Table:
    """A table as it is at this revision."""
    return sa.Table(table, sa.MetaData(), autoload_with=connection, resolve_fks=False)


def _put(connection: Connection, held: sa.Table, row: Mapping[Any, Any]) -> bool:
    key, content, guard = (_value(row[name]) for name in ("row_key", "content", "unless_changed"))
    now = connection.execute(sa.select(held).where(*_at(held, key))).mappings().first()
    if now is None:
        if not content.keys() >= {column.name for column in held.primary_key}:
            return False
        connection.execute(held.insert().values(**_with_null(content)))
        return True
    if any(now[name] != value for name, value in guard.items()):
        return False
    connection.execute(held.update().where(*_at(held, key)).values(**_with_null(content)))
    return True


def _with_null(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: sa.null() if value is None else value for name, value in content.items()}


def _key(held: sa.Table, row: Mapping[Any, Any]) -> dict[str, Any]:
    return {column.name: row[column.name] for column in held.primary_key}


def _at(held: sa.Table, key: Mapping[str, Any]) -> list[Any]:
    return [held.c[name] == value for name, value in key.items()]


def _text(value: Any) -> str:
    return json.dumps(value, default=lambda found: {"base64": base64.b64encode(found).decode()})


def _value(text: str) -> Any:
    return json.loads(text, object_hook=_bytes)


def _bytes(found: dict[str, Any]) -> Any:
    return base64.b64decode(found["base64"]) if found.keys() == {"base64"} else found
