"""What one service at a time has, of all that share a database: a turn, and that it lives; and secrets of them all.

On SQLite there is one service: whoever comes second is told who holds it. That is held by `flock` on two files: one in
the data folder, one beside the database's own file, so that two folders that name one database are found, too, through
whatever links. The kernel lets go when the process ends, however it ends.
On PostgreSQL turn and life are advisory locks of a connection: the server lets go when the connection ends, so whatever
a service held is free as soon as it is dead. Several services may share it, each with a data folder of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import json
import logging
import os
import secrets
import socket
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import IO

from sqlalchemy import Connection, Engine
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, OperationalError, SQLAlchemyError

from stimrig.api import owner_only
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, not_answering
from stimrig.api.settings import Settings
from stimrig.api.store.database import Store, sqlite_file
from stimrig.api.store.tables import Secret

log = logging.getLogger("stimrig.store")
Turn = AbstractAsyncContextManager[None]
LIMITS_TURN = "limits"
"""Who changes a participant's limits, and who lets a calibration or a test send by them, take turns: once a change is
answered nothing begins with what was before."""
KEY_TURN = "keys"
"""Trials of controllers' keys are counted and begun one after the other."""
LOCK_NOT_AVAILABLE = "55P03"
DEAD_AFTER = 2
"""A service is dead that was seen neither at this look nor at the one before: it may just be connecting again."""


class Holds:
    """A service among those that share a database. On SQLite it is the only one, and every other is dead."""

    def __init__(self) -> None:
        self.me = secrets.token_hex(8)
        """Drawn when the service starts."""
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)

    def turn(self, name: str) -> Turn:
        """Around what no two may do at once. Raises ApiError: 503 where the database does not answer."""
        return self._turns[name]

    def keep(self) -> None:
        """Show that this service lives; to be called again and again."""

    def dead(self, services: set[str]) -> set[str]:
        """Those that live no more; this one is asked for again and again, too."""
        return services - {self.me}

    def close(self) -> None:
        """Let everything go."""


class Among(Holds):
    """One of several services on a PostgreSQL database."""

    def __init__(self, engine: Engine) -> None:
        super().__init__()
        self._engine = engine.execution_options(isolation_level="AUTOCOMMIT")
        self._alive: Connection | None = None
        self._missed: defaultdict[str, int] = defaultdict(int)
        self.keep()

    @asynccontextmanager
    async def turn(self, name: str) -> AsyncIterator[None]:
        """As `Holds`."""
        async with self._turns[name]:  # within a service no connection waits
            taking = asyncio.get_running_loop().run_in_executor(None, self._take, f"turn {name}")
            try:
                held = await asyncio.shield(taking)
            except asyncio.CancelledError:  # it would come to who no longer wants it, and stay there
                taking.add_done_callback(lambda taken: self._let_go(taken, f"turn {name}"))
                raise
            except OperationalError as error:
                log.error("the turn %s was not had: %s", name, error)
                if getattr(error.orig, "sqlstate", "") != LOCK_NOT_AVAILABLE:
                    raise not_answering() from error
                detail = "Another service has begun what this must wait for. Nothing was changed. Try again."
                raise ApiError(503, "busy", "Somebody else is at it", detail) from error
            except SQLAlchemyError as error:
                log.error("the turn %s was not had: %s", name, error)
                raise not_answering() from error
            try:
                yield
            finally:
                await asyncio.shield(asyncio.to_thread(self._give_back, held, f"turn {name}"))

    def _take(self, name: str) -> Connection:
        connection = self._engine.connect()
        try:
            connection.exec_driver_sql(f"SELECT pg_advisory_lock({key(name)})")
        except BaseException:
            connection.close()
            raise
        return connection

    def _let_go(self, taken: asyncio.Future[Connection], name: str) -> None:
        if not taken.cancelled() and taken.exception() is None:
            taken.get_loop().run_in_executor(None, self._give_back, taken.result(), name)

    def _give_back(self, connection: Connection, name: str) -> None:
        try:
            connection.exec_driver_sql(f"SELECT pg_advisory_unlock({key(name)})")
            connection.close()
        except SQLAlchemyError:  # a connection that is gone holds nothing
            connection.invalidate()

    def keep(self) -> None:
        """As `Holds`."""
        try:
            if self._alive is None:
                self._alive = self._take(f"service {self.me}")
            self._alive.exec_driver_sql("SELECT 1")
        except SQLAlchemyError:
            log.warning("the database does not answer; this service connects again")
            if self._alive is not None:
                self._alive.invalidate()
                self._alive.close()
            self._alive = None

    def dead(self, services: set[str]) -> set[str]:
        """As `Holds`."""
        others = services - {self.me}
        for service in others:
            self._missed[service] = 0 if self._lives(service) else self._missed[service] + 1
        return {service for service in others if self._missed[service] >= DEAD_AFTER}

    def _lives(self, service: str) -> bool:
        number = key(f"service {service}") & (2**64 - 1)
        where = f"classid = {number >> 32} AND objid = {number & 0xFFFFFFFF} AND objsubid = 1 AND granted"
        here = "database = (SELECT oid FROM pg_database WHERE datname = current_database())"
        query = f"SELECT 1 FROM pg_locks WHERE locktype = 'advisory' AND {here} AND {where}"
        with self._engine.connect() as connection:
            return connection.exec_driver_sql(query).first() is not None

    def close(self) -> None:
        """As `Holds`."""
        if self._alive is not None:
            self._alive.invalidate()
            self._alive.close()
            self._alive = None


def open_holds(store: Store) -> Holds:
    """What a service on this database has."""
    return Among(store.engine) if store.several else Holds()


def key(name: str) -> int:
    """The number of an advisory lock: 64 bits, with a sign."""
    return int.from_bytes(hashlib.sha256(f"stimrig {name}".encode()).digest()[:8], "big", signed=True)


class HeldError(OSError):
    """Another service holds the place, or it cannot be held; one line with the fix."""


class ServiceLock:
    """What this service holds.

    `settings`: data folder and database. Raises HeldError: another service holds one of them.
    """

    def __init__(self, settings: Settings) -> None:
        self._files: list[IO[str]] = []
        self._since_utc = Clock().utc()
        try:
            for place, shown, fix in _lock_places(settings):
                self._files.append(_take_file(place, shown, fix))
        except BaseException:
            self.release()
            raise
        self.tell("an address not known yet")

    def tell(self, address: str) -> None:
        """Write down who holds it, for whoever comes second."""
        words = {"pid": os.getpid(), "host": socket.gethostname(), "since_utc": self._since_utc, "address": address}
        for file in self._files:
            file.seek(0)
            file.truncate()
            file.write(json.dumps(words) + "\n")
            file.flush()

    def release(self) -> None:
        """Let go."""
        while self._files:
            self._files.pop().close()


def refuse_if_held(settings: Settings) -> None:
    """Say at once, before devices are started, that another service holds the place. Raises HeldError."""
    ServiceLock(settings).release()


def _lock_places(settings: Settings) -> Iterator[tuple[Path, Path, str]]:
    folder = owner_only.folder(settings.data_dir)
    yield folder / "service.lock", folder, "stop it, or take another folder: --data, STIMRIG_DATA_DIR"
    try:
        url = make_url(settings.database)
    except ArgumentError:
        return  # the store says what is wrong with it
    database = sqlite_file(url)
    if database is None:  # in memory: nobody else's; PostgreSQL: made for several
        return
    real = database.resolve()
    if real.exists() and real.stat().st_nlink > 1:
        raise HeldError(f"{real}: the file has {real.stat().st_nlink} names (hard links), SQLite needs one; keep one")
    owner_only.folder(real.parent)
    yield real.with_name(f"{real.name}.lock"), database, "stop it, or take another database: STIMRIG_DATABASE_URL"


def _take_file(place: Path, shown: Path, fix: str) -> IO[str]:
    try:
        file = os.fdopen(os.open(place, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+", encoding="utf-8")
    except OSError as error:
        raise HeldError(f"{place}: {error.strerror}; set STIMRIG_DATA_DIR to a folder this user may write") from error
    owner_only.close(place, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        with file:
            raise HeldError(f"{shown}: another service runs on it: {_holder(file)}; {fix}") from None
    except OSError as error:
        file.close()
        raise HeldError(f"{place}: cannot be locked ({error.strerror}); take a folder on a local disk") from error
    file.truncate(0)
    return file


def _holder(file: IO[str]) -> str:
    with contextlib.suppress(ValueError, KeyError, TypeError):
        said = json.loads(file.read())
        return f"process {said['pid']} on {said['host']}, since {said['since_utc']}, at {said['address']}"
    return "it starts just now"


SECRET_BYTES = 32


def shared_secret(store: Store, name: str) -> bytes:
    """A secret that all services share, so that a page of one is good at another: read, or drawn once.

    `name`: what it is for.
    """
    with store.write() as session:
        row = session.get(Secret, name)
        if row is None:
            row = Secret(name=name, value=secrets.token_bytes(SECRET_BYTES))
            session.add(row)
    return row.value
