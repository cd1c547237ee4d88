"""From an older database to today's, revision by revision, in one transaction. A newer database is left alone.

Each revision is a function `_NNNN` below; docs/decisions/0009-alembic.md says how to add one. Databases from before
Alembic kept a number in the table `schema_version`: they are taken over at the revision of that number.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from alembic.operations import Operations
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, Engine, inspect, text

from stimrig.api.store import aside, centre_tables, copies

BEFORE = "before-upgrade"
"""Folder beside a SQLite database for copies of it, made before an upgrade."""
WRITES = {"stimrig_writes": True}
"""Execution option of a transaction that writes."""
METADATA = centre_tables.Table.metadata
"""Of all tables: the centre's, too."""
NUMBERED = {0: "0001", 1: "0001", 2: "0002", 3: "0003", 4: "0004"}
"""The revision of each number in `schema_version`; 0: tables, but no number yet."""
VERSION = sa.Table(
    "alembic_version", sa.MetaData(), sa.Column("version_num", sa.String(32), nullable=False),
    sa.PrimaryKeyConstraint("version_num", name="alembic_version_pkc"),
)  # fmt: skip
"""Where Alembic keeps the revision."""


class SchemaError(Exception):
    """The database is not one that this version can use."""


def bring_up(engine: Engine) -> None:
    """Make or upgrade the tables; all of it is done, or nothing.

    Raises SchemaError: the database is newer than the software, or lacks a column that no revision adds.
    """
    with engine.connect() as connection:
        at = found_revision(connection)
        connection.rollback()
        if at == NEWEST:
            _refuse_lacking(connection)
            return
    with _copied_before(engine.url.database, at), engine.execution_options(**WRITES).begin() as writer:
        upgrade(writer)  # one service at a time, and only once


@contextmanager
def _copied_before(database: str | None, at: str | None) -> Iterator[None]:
    """Keep a copy of a SQLite database as it was, unless it stays so. Raises SchemaError: none can be made."""
    path = Path(database or "")
    if at is None or not path.is_file():  # new, in memory, or PostgreSQL: its backup is made by its own programs
        yield
        return
    copy = copies.free_name(path.parent / BEFORE, f"{path.stem}-{at}")
    try:
        copies.copy_database(path, copy)
        yield
    except BaseException as error:
        copy.unlink(missing_ok=True)
        if isinstance(error, copies.CopyError):
            raise SchemaError(f"it is of version {at} and is upgraded only with a copy: {error}") from error
        raise


def upgrade(connection: Connection) -> list[str]:
    """Upgrade in the caller's transaction; a line for what was set aside once and cannot come back.

    Raises SchemaError: see `bring_up`.
    """
    at, stays = found_revision(connection), []
    with Operations.context(MigrationContext.configure(connection)) as op:
        for revision, step in STEPS.items():
            if at is None or revision > at:
                step(op)
                stays += aside.bring_back(connection, revision)
    set_revision(connection, NEWEST)
    _refuse_lacking(connection)
    return stays


def found_revision(connection: Connection) -> str | None:
    """The revision at which a database stands; None: a new one. Raises SchemaError: it is newer than the software."""
    at = MigrationContext.configure(connection).get_current_revision() or _numbered(connection)
    if at is not None and at not in STEPS:
        raise _newer(at)
    return at


def set_revision(connection: Connection, revision: str) -> None:
    """Write down where the database stands now."""
    VERSION.create(connection, checkfirst=True)
    connection.execute(VERSION.delete())
    connection.execute(VERSION.insert().values(version_num=revision))


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


# ---- how revisions are written ----------------------------------------------------------------------------------

TYPES: dict[str, Any] = {
    "text": sa.Text, "string": sa.String, "json": sa.JSON, "float": sa.Float, "integer": sa.Integer,
    "boolean": sa.Boolean, "bytes": sa.LargeBinary, "bigint": sa.BigInteger,
    "word": sa.String().with_variant(sa.String(collation="C"), "postgresql"),
    "number": sa.BigInteger().with_variant(sa.Integer, "sqlite"),
}  # fmt: skip


NUMBERS: dict[str, Any] = {"auto": True, "given": False}
PARTICIPANT = "participant 32 > participants.code"
PARTICIPANT_INDEX = "participant 32 index > participants.code"


def _column(words: str) -> sa.Column[Any]:
    """A column as `name type`: with `?` it may be NULL; `key`, `index`, `unique`; behind `>` what it names.

    A key's number is counted by the database (`auto`), or `given`.

    A number as its type is the length of a string: the first revisions had them, 0010 takes them away.
    """
    about, _, target = words.partition(" > ")
    name, kind, *flags = about.split()
    plain = kind.removesuffix("?")
    options: dict[str, Any] = {flag: True for flag in flags if flag in ("index", "unique")}
    options |= {"primary_key": True, "autoincrement": NUMBERS.get(flags[-1], "auto")} if "key" in flags else {}
    made = sa.String(int(plain)) if plain.isdecimal() else TYPES[plain]
    return sa.Column(name, made, *([sa.ForeignKey(target)] if target else []), nullable=kind != plain, **options)


def _table(op: Operations, name: str, columns: str, **more: Any) -> Any:
    return op.create_table(name, *(_column(words) for words in columns.split(",")), **more)


def _add(op: Operations, table: str, columns: str) -> None:
    for words in columns.split(","):
        op.add_column(table, _column(words))


def _index(op: Operations, table: str, name: str, columns: str, unique: bool = False) -> None:
    op.create_index(f"ix_{table}_{name}", table, columns.split(), unique=unique)


# ---- the revisions ------------------------------------------------------------------------------------------------


def _0001(op: Operations) -> None:
    """The first tables."""
    _table(op, "participants", "code 32 key, profile json, created_utc 32, created_by 80")
    _table(op, "tests", f"""id 40 key, {PARTICIPANT_INDEX}, kind 40, state 20 index, reason text,
        plan json, summary json, recording_id 64?, model_id 64?, requested_by 80, requested_utc 32 index,
        finished_utc 32?""")  # fmt: skip
    _table(op, "recordings", f"""id 64 key, {PARTICIPANT_INDEX}, test_id 40? index, path text, file_sha256 64,
        origin 20, created_utc 32""")  # fmt: skip
    _table(op, "models", f"""id 64 key, {PARTICIPANT_INDEX}, recording_id 64 index > recordings.id, parent_id 64?,
        added_effect 64?, method 40, effects json, fit json, document bytes, etag 64, created_utc 32 index,
        created_by 80""")  # fmt: skip
    _table(op, "approvals", f"""id integer key auto, model_id 64 index > models.id, {PARTICIPANT_INDEX},
        approved boolean, reason text, by 80, at_utc 32""")  # fmt: skip
    _table(op, "analyses", "model_id 64 key > models.id, kind 40 key, document json, created_utc 32")
    _table(op, "tokens", """hash 64 key, prefix 16, name 80 index, scopes json, created_utc 32, expires_utc 32?,
        revoked boolean, origin 20""")  # fmt: skip
    _table(op, "page_sessions", """hash 64 key, token_hash 64 > tokens.hash, csrf 64, created_unix_s float,
        expires_unix_s float""")  # fmt: skip
    _table(op, "audit", """seq integer key given, at_utc 32, who 80, action 60, subject 120, detail json,
        previous_hash 64, hash 64""")  # fmt: skip


def _0002(op: Operations) -> None:
    """People with passwords, and the end of an approval.

    Databases from before versions were kept have some of this already, and none says which: what is there stays.
    """
    if "expires_utc" not in {column["name"] for column in inspect(op.get_bind()).get_columns("approvals")}:
        _add(op, "approvals", "expires_utc 32?")
    users = "name 80 key, password_hash 200, token_hash 64 > tokens.hash, created_utc 32, changed_utc 32"
    _table(op, "users", users, if_not_exists=True)
    _table(op, "confirmations", "session_hash 64 key, at_unix_s float", if_not_exists=True)


def _0003(op: Operations) -> None:
    """The places that people sign in from."""
    _table(op, "known_places", "name 80 key > users.name, place 60 key, at_unix_s float")


def _0004(op: Operations) -> None:
    """What is in doubt about an upload."""
    _add(op, "recordings", "warnings json?")


def _0005(op: Operations) -> None:
    """From here on `alembic_version` has the version.

    A stimrig from before Alembic reads `schema_version` alone. The number that it does not know makes it refuse the
    database, instead of taking it for one without a version.
    """
    op.bulk_insert(_table(op, "schema_version", "version integer key", if_not_exists=True), [{"version": 5}])


def _0006(op: Operations) -> None:
    """Side and muscle, the archive, notes, a structure that carries over, locked sessions, names without their case."""
    _add(op, "participants", "side 8?, muscle 60?, archived_utc 32?")
    _add(op, "tests", "ran_by 80?")
    _add(op, "models", "carried_from_id 64?, carried json?")
    _add(op, "page_sessions", "acted_unix_s float?, locked_unix_s float?")
    _table(op, "notes", f"""id 40 key, {PARTICIPANT_INDEX}, test_id 40? index > tests.id, at_s float?, kind 20,
        text text, by 80, at_utc 32, struck_by 80?, struck_utc 32?""")  # fmt: skip
    _add(op, "users", "folded_name 320?")
    _index(op, "users", "folded_name", "folded_name")
    users = sa.table("users", sa.column("name"), sa.column("folded_name"))
    connection = op.get_bind()
    for (name,) in connection.execute(sa.select(users.c.name)).all():
        connection.execute(sa.update(users).where(users.c.name == name).values(folded_name=_folded(name)))


def _folded(name: str) -> str:
    """As `stimrig.api.people.accounts` did when 0006 was written."""
    return " ".join(unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold()).split())


def _0007(op: Operations) -> None:
    """How far an approved model may be tracked (what was approved before: not at all), and a controller's trials."""
    _add(op, "approvals", "tracking json?")
    _table(op, "tracked", f"""test_id 40 key > tests.id, approval_id integer index > approvals.id, {PARTICIPANT},
        model_id 64 > models.id, recording_id 64?, number integer, outcome 20, reason text, step json?,
        error_percent float?, ask text?, document bytes?, etag 64?, at_utc 32, delay_s float?""")  # fmt: skip


def _0008(op: Operations) -> None:
    """Keys of controllers for one participant and one day. The tokens that are there are bound to nobody."""
    _add(op, "tokens", "participant 32?, plan json?")


def _0009(op: Operations) -> None:
    """A controller's key falls with the token of whoever made it. The keys that are there end with their day."""
    _add(op, "tokens", "made_by 64?")


def _0010(op: Operations) -> None:
    """Several services on one database. The tests that are open are followed by nobody.

    PostgreSQL holds columns to their lengths, which SQLite never did: there, lengths go. What a text may hold is
    checked where it comes in.
    """
    _add(op, "tests", "followed_by string?, rig string?")
    _table(op, "secrets", "name string key, value bytes")
    connection = op.get_bind()
    if connection.dialect.name != "postgresql":
        return
    seen = inspect(connection)
    for table in seen.get_table_names():
        for column in seen.get_columns(table):
            if getattr(column["type"], "length", None):
                op.alter_column(table, column["name"], type_=sa.String)


def _0011(op: Operations) -> None:
    """What a centre is told: a chain of items; what is there already is put in once a centre is configured."""
    _table(op, "outbox", """id integer key auto, chain string, seq integer, kind string, key string, body text,
        sha256 string, file string? index, file_bytes bigint?, at_utc string, previous string,
        hash string""")  # fmt: skip
    _index(op, "outbox", "chain_seq", "chain seq", unique=True)
    _index(op, "outbox", "kind_key", "kind key")


def _0012(op: Operations) -> None:
    """What a centre keeps of its rigs; the tables stay empty at a rig."""
    _table(op, "centre_rigs", """id integer key auto, name word unique, key_hash word unique, key_prefix string,
        created_utc string, created_by string, revoked_utc string?, seen_utc string?, version string?, state string?,
        reason text?, disk_free_bytes number?, disk_total_bytes number?, clock_difference_s float?,
        waiting_items number?, waiting_files number?, chain string?, audit_seq number?, audit_hash string?,
        recordings number""")  # fmt: skip
    _table(op, "centre_chains", """rig_id integer key > centre_rigs.id, chain word key, seq number, hash string,
        begun_utc string""")  # fmt: skip
    _table(op, "centre_items", """rig_id integer key > centre_rigs.id, chain word key, seq number key, kind word,
        key word, sha256 word, file word?, file_bytes number?, at_utc string, received_utc string, previous string,
        hash string, body text?""")  # fmt: skip
    _index(op, "centre_items", "file", "file")
    _index(op, "centre_items", "told", "rig_id kind key")
    _table(op, "centre_files", "sha256 word key, bytes number, whole_utc string, checked_utc string?, ok boolean")
    _table(op, "centre_wanted", "id number key auto, rig_id integer > centre_rigs.id, sha256 word, bytes number")
    _index(op, "centre_wanted", "file", "sha256 rig_id", unique=True)
    _index(op, "centre_wanted", "rig", "rig_id id")
    _table(op, "centre_warnings", """id integer key auto, rig_id integer? > centre_rigs.id, kind word, subject word,
        detail json, at_utc word, again_utc string, times integer, ended_utc word?, acknowledged_by string?,
        acknowledged_utc word?""")  # fmt: skip
    _index(op, "centre_warnings", "of", "rig_id kind subject")
    _index(op, "centre_warnings", "open", "acknowledged_utc id")
    _table(op, "centre_participants", """code word key, rig_id integer key > centre_rigs.id, side string?,
        muscle string?, archived_utc string?, sessions integer, recordings integer, last_utc word?,
        verdict string?""")  # fmt: skip
    _index(op, "centre_participants", "rig", "rig_id code")
    _table(op, "centre_sessions", """participant word key, day word key, rig_id integer key > centre_rigs.id,
        at_utc string, tests integer, recordings integer, model_id string?, model_utc string?, verdict word?,
        approved_by string?, current_ma float?""")  # fmt: skip
    _index(op, "centre_sessions", "day", "day participant rig_id")
    _index(op, "centre_sessions", "rig", "participant rig_id day")
    _index(op, "centre_sessions", "verdict", "verdict participant rig_id day")
    _centre_rows(op)


def _centre_rows(op: Operations) -> None:
    """Of 0012: the rows that sessions are made of."""
    _table(op, "centre_tests", """rig_id integer key > centre_rigs.id, id word key, participant word, kind string?,
        state string?, reason text?, recording_id string?, model_id string?, requested_utc word,
        finished_utc string?""")  # fmt: skip
    _index(op, "centre_tests", "participant", "participant requested_utc")
    _table(op, "centre_recordings", """id number key auto, rig_id integer > centre_rigs.id, recording_id word,
        participant word, test_id string?, origin string?, created_utc word, file word?,
        file_bytes number?""")  # fmt: skip
    _index(op, "centre_recordings", "of", "rig_id recording_id", unique=True)
    _index(op, "centre_recordings", "participant", "participant created_utc id")
    _index(op, "centre_recordings", "rig", "rig_id created_utc id")
    _index(op, "centre_recordings", "time", "created_utc id")
    _table(op, "centre_models", """rig_id integer key > centre_rigs.id, id word key, participant word,
        recording_id string?, parent_id string?, method string?, effects json, verdict string?, fit json,
        created_utc word, file word?, file_bytes number?""")  # fmt: skip
    _index(op, "centre_models", "participant", "participant created_utc")
    _table(op, "centre_effects", "effect word key, participant word key, rig_id integer key > centre_rigs.id")
    _table(op, "centre_decisions", """rig_id integer key > centre_rigs.id, sha256 word key, participant word,
        model_id string, approved boolean, reason text, by string, at_utc word""")  # fmt: skip
    _index(op, "centre_decisions", "participant", "participant at_utc")


def _0013(op: Operations) -> None:
    """A site for models and approvals (of what is there: the participant's of now), and the trail by its subjects."""
    _add(op, "participants", "placement string?")
    _add(op, "recordings", "site json?")
    _add(op, "approvals", "site json?")
    _index(op, "audit", "subject", "subject")
    connection = op.get_bind()
    people = sa.table("participants", sa.column("code"), sa.column("side"), sa.column("muscle"))
    for code, side, muscle in connection.execute(sa.select(people)).all():
        for name in ("recordings", "approvals"):
            rows = sa.table(name, sa.column("participant"), sa.column("site", sa.JSON))
            of_person = sa.update(rows).where(rows.c.participant == code)
            connection.execute(of_person.values(site=[side, muscle, None]))


def _0014(op: Operations) -> None:
    """Whether a rejection was an undo; of what is there, its reason tells."""
    _add(op, "approvals", "undone boolean?")
    rows = sa.table("approvals", sa.column("approved"), sa.column("reason"), sa.column("undone", sa.Boolean))
    said = sa.or_(rows.c.reason == "undone", sa.func.substr(rows.c.reason, 1, 8) == "undone: ")
    op.get_bind().execute(sa.update(rows).values(undone=sa.and_(sa.not_(rows.c.approved), said)))


def _0015(op: Operations) -> None:
    """What a participant has on the further channels of a rig; nobody has any yet."""
    _add(op, "participants", "channels json?")


def _0016(op: Operations) -> None:
    """Searches for the electrode of an array; there are none yet."""
    _table(op, "searches", """id string key, participant string index > participants.code, channel string,
        state string, asked json, document json, standing json, told json, chosen json?, created_by string,
        created_utc string, closed_by string?, closed_utc string?""")  # fmt: skip


def _0017(op: Operations) -> None:
    """Whom a provider signs in; nobody is linked yet. What is erased is written down before it is done."""
    _table(op, "identities", """issuer string key, subject string key, name string index > users.name,
        by_group boolean, linked_by string, linked_utc string""")  # fmt: skip
    _table(op, "erasures", """id string key, of string, reason text, asked_by string, asked_utc string, files json,
        done_utc string?""")  # fmt: skip


STEPS: dict[str, Callable[[Operations], None]] = {
    name[1:]: step for name, step in globals().items() if re.fullmatch("_[0-9]{4}", name)
}
"""Every revision, oldest first."""
NEWEST = max(STEPS)
