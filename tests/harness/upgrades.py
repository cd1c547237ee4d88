"""Data of version 0.1, upgraded and brought back in processes that are killed; what is lost then, and what half.

The data are made from a database that c6ff60e wrote (`tests/api/databases/12.sql`), filled up with rows and files.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, event

from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import audit, downgrades, migrations
from stimrig.api.upgrade import Request, upgrade

OLD = Path(__file__).parents[1] / "api/databases/12.sql"
AT = "2026-11-23T10:00:00.000Z"
MADE_SINCE = {"recordings": ("site",), "participants": ("placement", "channels"), "approvals": ("site", "undone")}
"""Columns that the old schema has not."""


def make_old(folder: Path, people: int, recordings: int) -> None:
    """A data folder as c6ff60e left it."""
    (folder / "recordings").mkdir(parents=True)
    with closing(sqlite3.connect(folder / "stimrig.db")) as database, database:
        database.executescript(OLD.read_text("utf-8"))
        database.execute("UPDATE recordings SET path = ? WHERE id = 'r1'", (str(_file(folder, "r1")),))
        for number in range(people):
            _person(database, f"X{number}")
        for number in range(recordings):
            _recording(database, folder, f"X{number % people}", f"x{number}")


def _file(folder: Path, name: str) -> Path:
    path = folder / "recordings" / f"{name}.h5"
    path.write_bytes(name.encode())
    return path


def _person(database: sqlite3.Connection, code: str) -> None:
    profile = {"current_ma": 18.0, "angle_range_rad": [0.4, 1.9]}
    row = (code, json.dumps(profile), AT, "Ada", "left", "biceps brachii")
    database.execute(
        "INSERT INTO participants (code, profile, created_utc, created_by, side, muscle) VALUES (?, ?, ?, ?, ?, ?)", row
    )


def _recording(database: sqlite3.Connection, folder: Path, code: str, name: str) -> None:
    """A recording, its model, a decision on it, and the entry of that."""
    digest, document = hashlib.sha256(name.encode()).hexdigest(), b'{"pad": "%s"}' % (b"x" * 4000)
    database.execute(
        "INSERT INTO recordings (id, participant, path, file_sha256, origin, created_utc) "
        "VALUES (?, ?, ?, ?, 'rig', ?)",
        (name, code, str(_file(folder, name)), digest, AT),
    )
    database.execute(
        "INSERT INTO models (id, participant, recording_id, method, effects, fit, document, etag, created_utc, "
        "created_by) VALUES (?, ?, ?, 'maximum-likelihood', '[]', '{}', ?, ?, ?, 'Ada')",
        (f"M{name}", code, name, document, hashlib.sha256(document).hexdigest(), AT),
    )
    database.execute(
        'INSERT INTO approvals (model_id, participant, approved, reason, "by", at_utc, expires_utc) '
        "VALUES (?, ?, 1, 'follows well', 'Ada', ?, ?)",
        (f"M{name}", code, AT, AT),
    )
    seq, previous = database.execute("SELECT seq, hash FROM audit ORDER BY seq DESC LIMIT 1").fetchone()
    fields = {
        "seq": seq + 1, "at_utc": AT, "who": "Ada", "action": "approve", "subject": f"M{name}", "detail": {},
        "previous_hash": previous,
    }  # fmt: skip
    row = (seq + 1, AT, "Ada", "approve", f"M{name}", "{}", previous, audit.entry_hash(fields))
    database.execute("INSERT INTO audit VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)


def make_since(folder: Path, number: int, new: bool) -> None:
    """What people do between one upgrade and the next; in the new version with what the old one cannot hold."""
    code, name = f"{'N' if new else 'O'}{number}", f"{'n' if new else 'o'}{number}"
    with closing(sqlite3.connect(folder / "stimrig.db")) as database, database:
        _person(database, code)
        _recording(database, folder, code, name)
        if new:
            profile = json.dumps({"current_ma": 18.0, "angle_set_at_utc": AT})
            database.execute(
                "UPDATE participants SET placement = '2 cm distal', channels = ?, profile = ? WHERE code = ?",
                (json.dumps({"triceps": {"muscle": "triceps brachii"}}), profile, code),
            )
            database.execute("UPDATE approvals SET undone = 1 WHERE model_id = ?", (f"M{name}",))
            database.execute(
                "INSERT INTO searches (id, participant, channel, state, asked, document, standing, told, created_by, "
                "created_utc) VALUES (?, ?, '', 'open', '{}', '{}', '{}', '[]', 'Ada', ?)", (name, code, AT),
            )  # fmt: skip


# ---- what there is, and whether it is whole ----------------------------------------------------------------------


def rows_of(folder: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """Every row of every table by its key, with what is aside put to where it belongs; and every file."""
    with closing(sqlite3.connect(folder / "stimrig.db")) as database:
        database.row_factory = sqlite3.Row
        names = [row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        found: dict[str, dict[str, dict[str, Any]]] = {}
        for name in set(names) - {"alembic_version", "set_aside", "schema_version"}:
            keys = [row["name"] for row in database.execute(f"PRAGMA table_info({name})") if row["pk"]]
            rows = [dict(row) for row in database.execute(f"SELECT * FROM {name}")]
            found[name] = {json.dumps([row[key] for key in keys]): row for row in rows}
        for row in found["approvals"].values():  # what the old schema has in words
            row.setdefault("undone", int(not row["approved"] and str(row["reason"]).startswith("undone")))
        for row in database.execute("SELECT * FROM set_aside") if "set_aside" in names else []:
            key = json.dumps(list(json.loads(row["row_key"]).values()))
            stored = {
                name: json.dumps(value) if isinstance(value, dict | list) else value
                for name, value in json.loads(row["content"]).items()
            }
            found.setdefault(row["of_table"], {}).setdefault(key, {}).update(stored)
    sealed = {path.name: {"bytes": path.read_bytes()} for path in (folder / "recordings").iterdir()}
    return {**found, "files": sealed}


def lost_between(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What was there before and is not, or is otherwise; entries of the trail may have been added."""
    lost = []
    for name, rows in before.items():
        for key, row in rows.items():
            now = after.get(name, {}).get(key)
            for column, value in row.items():
                if now is None or (value is not None and now.get(column) != value):
                    lost.append(f"{name} {key} {column}")
    return lost


def half(folder: Path) -> list[str]:
    """Why the data are neither whole and old nor whole and new."""
    with closing(sqlite3.connect(folder / "stimrig.db")) as database:
        revision = database.execute("SELECT version_num FROM alembic_version").fetchone()[0]
        wrong = [row[0] for row in database.execute("PRAGMA integrity_check") if row[0] != "ok"]
        wrong += [str(row) for row in database.execute("PRAGMA foreign_key_check")]
        for name, columns in MADE_SINCE.items():
            has = {row[1] for row in database.execute(f"PRAGMA table_info({name})")}
            if any((column in has) != (revision == migrations.NEWEST) for column in columns):
                wrong.append(f"{name} at {revision} has {sorted(has)}")
    if revision not in (migrations.NEWEST, downgrades.OLDEST):
        wrong.append(f"at {revision}")
    for copy in (folder / migrations.BEFORE).glob("stimrig-*.db"):
        with closing(sqlite3.connect(copy)) as database:
            wrong += [f"{copy.name}: {row[0]}" for row in database.execute("PRAGMA quick_check") if row[0] != "ok"]
        copy.unlink()  # else every round copies more
    return wrong


# ---- killed ------------------------------------------------------------------------------------------------------


def run(folder: Path, back: bool) -> dict[str, Any]:
    """An upgrade, or the way back, in this process."""
    return upgrade(Settings(data_dir=folder, database_url=None), Request(back=back), Clock())


def in_child(work: Callable[[], object], kill_after_s: float | None = None) -> bool:
    """Whether it came to its end; else it was killed."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException as error:
            print(f"failed: {error!r}", flush=True)
            os._exit(1)
    if kill_after_s is not None:
        time.sleep(kill_after_s)
        os.kill(child, signal.SIGKILL)  # one that has ended stays until it is waited for
    status = os.waitpid(child, 0)[1]
    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
        raise RuntimeError("an upgrade failed without having been killed")
    return os.WIFEXITED(status)


def killed_at_statement(folder: Path, back: bool, number: int) -> Callable[[], object]:
    """The work of a process that kills itself before its so many-th statement."""

    def work() -> None:
        seen = [0]

        def count(*_: object) -> None:
            seen[0] += 1
            if seen[0] == number:
                os.kill(os.getpid(), signal.SIGKILL)

        event.listen(Engine, "before_cursor_execute", count)
        event.listen(Engine, "commit", count)
        run(folder, back)

    return work


def statements(folder: Path, back: bool) -> int:
    """How many an upgrade has, told by a process that does it."""
    read, write = os.pipe()

    def work() -> None:
        seen = [0]
        event.listen(Engine, "before_cursor_execute", lambda *_: seen.__setitem__(0, seen[0] + 1))
        event.listen(Engine, "commit", lambda *_: seen.__setitem__(0, seen[0] + 1))
        run(folder, back)
        os.write(write, str(seen[0]).encode())

    in_child(work)
    return int(os.read(read, 20))


def campaign(folder: Path, people: int, recordings: int, moments: int, by_statement: bool) -> dict[str, Any]:
    """Rounds of upgrade and back, each killed once and then brought to its end."""
    make_old(folder, people, recordings)
    lost: list[str] = []
    halves: list[str] = []
    killed = {"upgrade": 0, "back": 0}
    lasts: dict[bool, float] = {}
    for back in (False, True):  # nobody kills the first ones: they say how long it takes
        began_s = time.perf_counter()
        count = statements(folder, back)
        lasts[back] = count if by_statement else time.perf_counter() - began_s
    for number in range(moments):
        for back in (False, True):
            make_since(folder, number, new=back)
            before, share = rows_of(folder), (number + 0.5) / moments
            if by_statement:
                ended = in_child(killed_at_statement(folder, back, 1 + int(share * lasts[back])))
            else:
                ended = in_child(lambda back=back: run(folder, back), share * lasts[back])
            killed["back" if back else "upgrade"] += not ended
            halves += half(folder)
            lost += lost_between(before, rows_of(folder))
            in_child(lambda back=back: run(folder, back))
            halves += half(folder)
            lost += lost_between(before, rows_of(folder))
    trail_whole = not run(folder, True)["doubts"] and not run(folder, False)["doubts"]
    sizes = {"people": people, "recordings": recordings, "moments": moments}
    return {**sizes, "killed": killed, "lost": lost, "half": halves, "whole": trail_whole}
