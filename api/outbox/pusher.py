"""The pusher: hello, items, files, wait; after a failure a longer wait.

It keeps no marks of what was sent: the centre says what it has.
"""

from __future__ import annotations

import json
import logging
import os
import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
from sqlalchemy import select, tuple_
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.clock import Clock, utc_label
from stimrig.api.outbox import feed, receipts, status
from stimrig.api.outbox.files import Files, Sending
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.messages import KeyRefusedError, PushError, RefusedError, UnreachableError
from stimrig.api.outbox.receipts import Receipt
from stimrig.api.outbox.status import Status
from stimrig.api.outbox.telling import Telling
from stimrig.api.settings import Settings, loopback
from stimrig.api.store import Store
from stimrig.api.store.audit import digest
from stimrig.api.store.tables import OutboxItem
from stimrig.api.version import software_version

HELLO_S = 30.0
POLL_S = 1.0
REVOKED_S = 900.0
TOLD_S = 30.0
"""The status is written at least so often."""
GOOD_S = 180.0
"""One that is older was left by a pusher that does not run: a chunk on a slow line takes a while."""
LEAST_SHARE = 1 / 32
FIRST_S, LONGEST_S = 1.0, 300.0
"""Waits after failures."""
HEALTH_S, LONGEST_HEALTH = 2.0, 65536
MOST_DAMAGED_TOLD, MOST_DAMAGED_SHOWN = 1000, 20
log = logging.getLogger("stimrig.outbox")


class Backoff:
    """Waits from 1 s to 5 min, longer each time, and by chance up to half shorter: never all rigs at once."""

    def __init__(self, chance: random.Random) -> None:
        self.chance, self.failures = chance, 0

    def next_s(self) -> float:
        wait_s = min(LONGEST_S, FIRST_S * 2.0 ** min(self.failures, 20))
        self.failures += 1
        return max(FIRST_S, wait_s * self.chance.uniform(0.5, 1.0))

    def reset(self) -> None:
        self.failures = 0


class Pusher:
    """Tells a centre what the outbox holds.

    `sleep`: waits so many seconds; `chance`: spreads the waits after failures.
    """

    def __init__(
        self, store: Store, settings: Settings, clock: Clock, link: Link,
        sleep: Callable[[float], None] = time.sleep, chance: random.Random | None = None,
    ) -> None:  # fmt: skip
        self.store, self.settings, self.clock, self.link, self.sleep = store, settings, clock, link, sleep
        chance = chance or random.Random()
        self.files = Files(store)
        self.telling = Telling(store, clock, link, self._about)
        self.sending = Sending(link, self.files)
        self.collecting = Collecting(store, settings, link)
        self.line, self.bucket, self.database = Backoff(chance), Backoff(chance), Backoff(chance)
        self.share = 1.0
        """Of the largest batch or chunk: less on a line that breaks."""
        self._missing: Iterator[int] | None = feed.batches(store, clock)
        self._hello_s = self._line_s = self._files_s = self._database_s = self.clock.monotonic_s()
        """When each may be tried next."""
        self._wrong: PushError | None = None
        self._wrong_files: PushError | None = None
        self._database_words = ""
        self._contact_utc: str | None = None
        self._told: tuple[float, Status] | None = None
        self._file = _file_of(store)
        self._take_up()

    def run(self) -> None:
        """Go on until the database is another one: a backup was restored, and what is open here is the old one."""
        while _file_of(self.store) == self._file:
            self.sleep(self.turn())
        log.warning("the database was replaced or is gone: to be started anew")

    def turn(self) -> float:
        """Do a bounded piece of work; how long to wait before the next one, s."""
        busy = False
        try:
            if self.clock.monotonic_s() >= self._database_s:
                if self._missing is not None and next(self._missing, None) is None:
                    self._missing = None
                busy = self._missing is not None
                busy = self._push() or busy
                self._database_words = ""
            if self._told is None or self.clock.monotonic_s() >= self._told[0] + POLL_S:
                self._write_status()
            if not self._database_words:
                self.database.reset()
        except SQLAlchemyError as error:
            first = self.database.failures == 0
            self._database_s = self.clock.monotonic_s() + self.database.next_s()
            self._missing = feed.batches(self.store, self.clock)
            self._database_words = str(error).splitlines()[0][:200]
            if first:
                log.warning("the rig's database: %s", self._database_words)
            self._write_status()
            busy = False
        return 0.0 if busy else self._rest_s()

    def _rest_s(self) -> float:
        """Until what is new has to be noticed; after a failure until it is tried again, or the status is old."""
        now_s = self.clock.monotonic_s()
        wait_s = max(self._line_s, self._database_s) - now_s
        return min(max(wait_s, POLL_S), TOLD_S)

    # ---- the line ----------------------------------------------------------------------------------------------

    def _push(self) -> bool:
        if self.clock.monotonic_s() < self._line_s:
            return False
        try:
            busy = self._step()
        except PushError as error:
            self._failed(error)
            return False
        if busy:
            self.share = min(1.0, self.share * 1.5)
        return busy

    def _step(self) -> bool:
        """One request, if one is due; whether there may be more at once."""
        if self.telling.at is None or self.clock.monotonic_s() >= self._hello_s:
            self._hello()
            return True
        if self.telling.send(self.share):
            self._went_well()
            self.sending.asked = self.collecting.asked = False
            return True
        if self._missing is None and self.collecting.step():  # once all is told its receipts have no holes
            return True
        busy = self._step_files()
        if busy or not self.sending.queue:
            self._went_well()
        return busy

    def _hello(self) -> None:
        if self.telling.hello():
            self._missing = feed.batches(self.store, self.clock)
        self._hello_s = self.clock.monotonic_s() + HELLO_S
        if not self.sending.queue:
            self.sending.asked = False  # the centre may have lost one
        self._contact_utc = self.clock.utc()

    def _went_well(self) -> None:
        """It took what it was sent, or there is nothing to send: that it answers a hello is not enough."""
        self._contact_utc = self.clock.utc()
        self.line.reset()
        if self._wrong is not None:
            log.info("the centre answers again")
        self._wrong = None

    def _step_files(self) -> bool:
        """Files have waits of their own: a bucket that is full keeps no item back."""
        if self.clock.monotonic_s() < self._files_s:
            return False
        try:
            busy = self.sending.step(self.share)
        except (UnreachableError, KeyRefusedError):
            raise
        except PushError as error:
            self._files_s = self.clock.monotonic_s() + self.bucket.next_s()
            if self._wrong_files is None or self._wrong_files.state != error.state:
                log.warning("%s", error)
            self._wrong_files = error
            return False
        except OSError as error:  # it is gone, or cannot be read: the next look finds it damaged
            log.warning("a file for the centre: %s", error)
            self._files_s = self.clock.monotonic_s() + self.bucket.next_s()
            return False
        self.bucket.reset()
        self._wrong_files = None
        return busy

    def _failed(self, error: PushError) -> None:
        wait_s = self.line.next_s()
        if isinstance(error, KeyRefusedError):
            wait_s = REVOKED_S * self.line.chance.uniform(0.7, 1.0)
        if isinstance(error, UnreachableError):
            self.share = max(LEAST_SHARE, self.share / 2)
        if self._wrong is None or self._wrong.state != error.state:
            log.warning("%s; nothing is lost, it is tried again", error)
        self._wrong = error
        self.telling.at = None
        self._line_s = self.clock.monotonic_s() + wait_s

    # ---- what is told of itself -----------------------------------------------------------------------------------

    def _about(self) -> dict[str, Any]:
        """What hello says beside the chain."""
        items, files = self.telling.waiting()
        disk = shutil.disk_usage(self.settings.data_dir)
        return {
            "version": software_version(),
            "utc": self.clock.utc(),
            "disk_free_bytes": disk.free,
            "disk_total_bytes": disk.total,
            **rig_state(self.settings),
            "damaged": sorted(self.files.damaged)[:MOST_DAMAGED_TOLD],
            "waiting_items": items,
            "waiting_files": files + len(self.sending.queue),
        }

    def _take_up(self) -> None:
        """What a pusher before this one has written is where people go on reading; the centre is asked all the same."""
        before = status.last(self.settings)
        if before is not None:
            self._contact_utc = before.last_contact_utc
            self.telling.reached = (before.chain, before.seq) if before.chain else None

    def _write_status(self) -> None:
        """Write it where it has changed, or is old."""
        new = self._status()
        if self._told is not None:
            told_s, old = self._told
            of = (old.state, old.detail, old.items_waiting, old.files_waiting, old.damaged_count)
            same = of == (new.state, new.detail, new.items_waiting, new.files_waiting, new.damaged_count)
            if same and self.clock.monotonic_s() < told_s + TOLD_S:
                return
        try:
            status.write(self.settings.data_dir, new)
        except OSError as error:
            log.warning("the status: %s", error)
        self._told = (self.clock.monotonic_s(), new)

    def _status(self) -> Status:
        items = files = 0
        if not self._database_words:
            items, files = self.telling.waiting()
        files += len(self.sending.queue)
        wrong = self._wrong or self._wrong_files
        if self._database_words:
            state, detail = "database", self._database_words
        elif wrong is not None:
            state, detail = wrong.state, str(wrong)
        elif self._contact_utc is None or self.telling.at is None:
            state, detail = "starting", ""
        elif items or files:
            state, detail = "sending", ""
        else:
            state, detail = ("damaged" if self.files.damaged else "current"), ""
        chain, seq = self.telling.reached or (None, 0)
        return Status(
            state, detail, self.link.url, self.clock.utc(), utc_label(self.clock.unix_s() + GOOD_S), self._contact_utc,
            chain, seq, items, files, tuple(sorted(self.files.damaged)[:MOST_DAMAGED_SHOWN]), len(self.files.damaged),
        )  # fmt: skip


def _file_of(store: Store) -> tuple[int, int] | None:
    """Which file the database is; None where it is none, or gone."""
    url = store.engine.url
    try:
        found = Path(url.database or "").stat() if url.get_backend_name() == "sqlite" else None
    except OSError:
        return None
    return None if found is None else (found.st_dev, found.st_ino)


def rig_state(settings: Settings) -> dict[str, Any]:
    """`state` and `reason` as `GET /health` tells anybody on this machine; its address stands in the service's lock."""
    unknown = {"state": None, "reason": None}
    try:
        address = json.loads((settings.data_dir / "service.lock").read_text("utf-8"))["address"]
        if not loopback(urlsplit(address).hostname or ""):
            return unknown
        with (
            httpx.Client(timeout=HEALTH_S, trust_env=False) as http,
            http.stream("GET", f"{address}/health") as answer,
        ):
            body = next(answer.iter_bytes(LONGEST_HEALTH), b"")
        rig = json.loads(body)["rig"]
        return {"state": _text(rig.get("state")), "reason": _text(rig.get("reason"))}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, httpx.HTTPError, httpx.InvalidURL):
        return unknown


def _text(value: object) -> str | None:
    return value[:200] if isinstance(value, str) else None


class Collecting:
    """Asks a centre for its receipts, and keeps them: a file for each centre and key, so that none are mixed up.

    `asked`: whether it was asked since something new was told.
    """

    def __init__(self, store: Store, settings: Settings, link: Link) -> None:
        self.store, self.link, self.asked = store, link, False
        key = settings.centre_key.get_secret_value() if settings.centre_key else ""
        self.path = settings.data_dir / f"receipts-{digest(f'{settings.centre_url} {key}')[:16]}.jsonl"
        self._after, self._row_id = ("", 0), 0
        if self.path.exists():
            self._take_up()

    def step(self) -> bool:
        """Ask for the next ones; whether there may be more. Raises PushError, but where the centre is an older one."""
        if self.asked:
            return False
        self.asked = True
        try:
            given = self.link.heads(*self._after)
            kept = self._keep_ours(given)
            if kept:
                receipts.append(self.path, kept)
        except (RefusedError, OSError) as error:
            log.warning("receipts of the audit trail: %s", error)
            return False
        if given:
            self._after = (given[-1].chain, given[-1].item)
        self.asked = not kept
        return bool(kept)

    def _keep_ours(self, given: list[Receipt]) -> list[Receipt]:
        """Those of items that this rig has told, each once: a centre that makes up others fills no disk."""
        place = tuple_(OutboxItem.chain, OutboxItem.seq).in_([(one.chain, one.item) for one in given])
        columns = (OutboxItem.chain, OutboxItem.seq, OutboxItem.id)
        with self.store.read() as session:
            rows = session.execute(select(*columns).where(OutboxItem.kind == "audit", place))
            ids = {(chain, seq): row_id for chain, seq, row_id in rows}
        kept = []
        for one in given:
            row_id = ids.get((one.chain, one.item), 0)
            if row_id > self._row_id:
                self._row_id = row_id
                kept.append(one)
        return kept

    def _take_up(self) -> None:
        """Go on after the last one; half a line that a loss of power left is taken away."""
        whole = self.path.read_bytes().rpartition(b"\n")
        if whole[2]:
            os.truncate(self.path, len(whole[0]) + len(whole[1]))
        for _, one in receipts.read(self.path):
            if one is not None:
                self._after = (one.chain, one.item)
