"""What of an export is done: a small database beside it, so that one that is cut off goes on where it was."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stimrig.api.cohort.tasks import CohortError

FOLDER = ".stimrig-export"
TABLES = """
CREATE TABLE IF NOT EXISTS options (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS done (address TEXT PRIMARY KEY, stamp TEXT NOT NULL, sha256 TEXT NOT NULL,
  participant TEXT NOT NULL, session TEXT NOT NULL, row TEXT NOT NULL);
CREATE UNIQUE INDEX IF NOT EXISTS done_content ON done (sha256);
CREATE INDEX IF NOT EXISTS done_order ON done (participant, session);
CREATE TABLE IF NOT EXISTS failed (address TEXT PRIMARY KEY, kind TEXT NOT NULL, reason TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS labels (label TEXT PRIMARY KEY, code TEXT NOT NULL UNIQUE);
CREATE TABLE IF NOT EXISTS numbers (code TEXT, record TEXT, number INTEGER NOT NULL, PRIMARY KEY (code, record));
"""


class State:
    """The database of one export folder.

    Parameters
    ----------
    folder : Path
        Where the export goes; made if it is not there.
    options : dict
        What the export was asked for; a folder that was begun with others is refused.

    Raises
    ------
    CohortError
        The folder holds something else, another export, or cannot be written.
    """

    def __init__(self, folder: Path, options: dict[str, Any]) -> None:
        self.folder, self.place = folder, folder / FOLDER
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not self.place.is_dir() and any(folder.iterdir()):
                raise CohortError(f"{folder}: is not empty, and no export of ours. Give a new folder.")
            self.place.mkdir(exist_ok=True)
            for leftover in self.place.glob("*.part"):
                leftover.unlink()
            self._db = sqlite3.connect(self.place / "state.db")
            self._db.executescript(TABLES)
        except OSError as error:
            raise CohortError(f"{folder}: {error.strerror}. Give a folder that can be written.") from None
        except sqlite3.Error as error:
            raise CohortError(f"{self.place}: {error}. Remove the folder and begin again.") from None
        begun = self.option("options", json.dumps(options))
        if json.loads(begun) != options:
            self._db.close()
            raise CohortError(f"{folder}: was begun with other options ({begun}). Give these, or a new folder.")

    def option(self, name: str, default: str) -> str:
        """What is kept under a name; the default is kept from now on where nothing is."""
        with self._db:
            self._db.execute("INSERT OR IGNORE INTO options VALUES (?, ?)", (name, default))
        return str(self._db.execute("SELECT value FROM options WHERE name = ?", (name,)).fetchone()[0])

    def is_done(self, address: str, stamp: str) -> bool:
        """Whether that record was exported as it is now."""
        row = self._db.execute("SELECT stamp FROM done WHERE address = ?", (address,)).fetchone()
        return row is not None and stamp != "" and row[0] == stamp

    def is_copy(self, address: str, sha256: str) -> bool:
        """Whether another record with this content was exported."""
        row = self._db.execute("SELECT address FROM done WHERE sha256 = ?", (sha256,)).fetchone()
        return row is not None and row[0] != address

    def files(self, address: str) -> list[str]:
        """The files in which a record was exported, as it was then."""
        row = self._db.execute("SELECT row FROM done WHERE address = ?", (address,)).fetchone()
        return [] if row is None else json.loads(row[0]).get("files", [])

    def done(self, address: str, stamp: str, sha256: str, who: tuple[str, str], row: dict[str, Any]) -> None:
        """A record's files are in their places."""
        with self._db:
            self._db.execute("DELETE FROM failed WHERE address = ?", (address,))
            self._db.execute(
                "INSERT OR REPLACE INTO done VALUES (?, ?, ?, ?, ?, ?)",
                (address, stamp, sha256, *who, json.dumps(row, ensure_ascii=False)),
            )

    def failed(self, address: str, kind: str, reason: str) -> None:
        with self._db:
            self._db.execute(
                "INSERT OR REPLACE INTO failed VALUES (?, ?, ?)", (address, kind, " ".join(reason.split()))
            )

    def label(self, code: str) -> str:
        """The label of a code: its letters and digits; the same for the same code.

        Raises ValueError: another code has that label, or nothing is left of it.
        """
        label = "".join(letter for letter in code if letter.isascii() and letter.isalnum())
        if not label:
            raise ValueError(f"participant {code!r} has no letter and no digit for a label")
        row = self._db.execute("SELECT code FROM labels WHERE lower(label) = lower(?)", (label,)).fetchone()
        if row is not None and row[0] != code:
            raise ValueError(f"participant {code!r}: its label {label} is that of {row[0]!r} already, capitals aside")
        with self._db:
            self._db.execute("INSERT OR IGNORE INTO labels VALUES (?, ?)", (label, code))
        return label

    def number(self, code: str, record: str) -> int:
        """The number of a record among those of a code, from 1: the same for ever, whatever comes later."""
        given = "SELECT number FROM numbers WHERE code = ? AND record = ?"
        with self._db:
            count = "(SELECT count(*) + 1 FROM numbers WHERE code = ?)"
            self._db.execute(f"INSERT OR IGNORE INTO numbers VALUES (?, ?, {count})", (code, record, code))
        return int(self._db.execute(given, (code, record)).fetchone()[0])

    def labels(self) -> Iterator[tuple[str, str]]:
        yield from self._db.execute("SELECT label, code FROM labels ORDER BY label")

    def rows(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Participant, session and row of what was exported, in this order."""
        for participant, session, row in self._db.execute(
            "SELECT participant, session, row FROM done ORDER BY participant, session, address"
        ):
            yield participant, session, json.loads(row)

    def failures(self) -> Iterator[tuple[str, str, str]]:
        """Address, kind and reason of what was not."""
        yield from self._db.execute("SELECT address, kind, reason FROM failed ORDER BY address")

    def count(self, table: str) -> int:
        assert table in ("done", "failed")
        return int(self._db.execute(f"SELECT count(*) FROM {table}").fetchone()[0])

    def close(self) -> None:
        self._db.close()
