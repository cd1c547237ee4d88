"""What the load of a centre is made of: processes that are killed, lines that are cut, and a look at what is where."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import sqlite3
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import create_engine, text

from bench.common import ROOT
from tests.harness.fake_centre import FIELDS, ZEROS, canonical, sha256
from tests.harness.hostile_files import peak

PATIENCE_S = 300.0


@dataclass
class Kept:
    """A process that is started again after it was killed."""

    command: list[str]
    environment: dict[str, str]
    log: Path
    health: str | None = None
    popen: subprocess.Popen[bytes] | None = None
    kills: int = 0
    ended: bool = False

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.popen = subprocess.Popen(
                self.command, cwd=ROOT, env={**os.environ, **self.environment}, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip

    def wait_healthy(self) -> None:
        """Until it answers."""
        end = time.monotonic() + PATIENCE_S
        while self.health is not None:
            with contextlib.suppress(httpx.HTTPError):
                if httpx.get(self.health, timeout=5).status_code < 500:
                    return
            if time.monotonic() > end or (self.popen is not None and self.popen.poll() is not None):
                raise RuntimeError(f"{self.health} does not answer; its log: {self.log.read_text()[-2000:]}")
            time.sleep(0.2)

    def kill(self) -> None:
        """SIGKILL, as a power cut or the kernel's out-of-memory killer would."""
        if self.popen is not None:
            self.popen.send_signal(signal.SIGKILL)
            self.popen.wait()
            self.kills += 1

    def end(self) -> None:
        self.ended = True
        if self.popen is not None and self.popen.poll() is None:
            self.popen.terminate()
            try:
                self.popen.wait(20)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait()

    def peak_mb(self) -> float:
        """The most memory that it has had, MB."""
        return 0.0 if self.popen is None else peak(self.popen.pid)


class Lines:
    """A line for each rig to the centre, that drops and stalls for random stretches; in a thread of its own."""

    def __init__(self, ports: list[int], centre_port: int, seed: int) -> None:
        self.ports, self.centre_port = ports, centre_port
        self.chance = random.Random(seed)
        self.calm = threading.Event()
        """No harm any more."""
        self.stretches: Counter[str] = Counter()
        self._mode = dict.fromkeys(ports, "pass")
        self._open: dict[int, set[asyncio.StreamWriter]] = {port: set() for port in ports}
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._ready.wait(PATIENCE_S)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(10)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()

    async def _end(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        for port in self.ports:
            serve = partial(self._serve, port)
            self._loop.run_until_complete(asyncio.start_server(serve, "127.0.0.1", port))
            self._loop.create_task(self._weather(port))
        self._ready.set()
        self._loop.run_forever()

    async def _weather(self, port: int) -> None:
        while not self.calm.is_set():
            await asyncio.sleep(self.chance.uniform(3, 15))
            self._mode[port] = self.chance.choice(("drop", "stall"))
            self.stretches[self._mode[port]] += 1
            if self._mode[port] == "drop":
                for writer in list(self._open[port]):
                    writer.transport.abort()
            await asyncio.sleep(self.chance.uniform(1, 10))
            self._mode[port] = "pass"

    async def _serve(self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open[port].add(writer)
        try:
            if self._mode[port] == "drop":
                return
            there, back = await asyncio.open_connection("127.0.0.1", self.centre_port)
            self._open[port].add(back)
            try:
                await asyncio.gather(self._pipe(port, reader, back), self._pipe(port, there, writer))
            finally:
                self._open[port].discard(back)
                back.transport.abort()
        except (OSError, asyncio.CancelledError):  # it is cut, or the bench ends
            pass
        finally:
            self._open[port].discard(writer)
            writer.transport.abort()

    async def _pipe(self, port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            while self._mode[port] == "stall":
                await asyncio.sleep(0.1)
            if self._mode[port] == "drop":
                raise ConnectionAbortedError
            writer.write(data)
            await writer.drain()
        raise ConnectionAbortedError


# ---- what is where --------------------------------------------------------------------------------------------------


@dataclass
class Seen:
    """What was found at the end."""

    items_at_rigs: int = 0
    items_at_centre: int = 0
    files_at_rigs: int = 0
    files_at_centre: int = 0
    lost_items: int = 0
    lost_files: int = 0
    doubled: int = 0
    out_of_order: int = 0
    wrong_hashes: int = 0
    kinds: Counter[str] = field(default_factory=Counter)

    @property
    def good(self) -> bool:
        return not (self.lost_items or self.lost_files or self.doubled or self.out_of_order or self.wrong_hashes)


def of_rig(folder: Path) -> list[dict[str, Any]]:
    """A rig's items, all chains, in the order they were written."""
    database = sqlite3.connect(f"file:{folder / 'stimrig.db'}?mode=ro", uri=True, timeout=30)
    with contextlib.closing(database):
        database.row_factory = sqlite3.Row
        return [dict(row) for row in database.execute("SELECT * FROM outbox ORDER BY id")]


def of_centre(url: str) -> dict[str, list[dict[str, Any]]]:
    """The centre's items by rig, in the order of chain and number."""
    engine = create_engine(url)
    query = (
        "SELECT r.name AS rig, i.* FROM centre_items i JOIN centre_rigs r ON r.id = i.rig_id ORDER BY i.chain, i.seq"
    )
    found: dict[str, list[dict[str, Any]]] = {}
    with engine.connect() as connection:
        for row in connection.execute(text(query)).mappings():
            found.setdefault(row["rig"], []).append(dict(row))
    engine.dispose()
    return found


def item_hash(item: dict[str, Any]) -> str:
    """As decision 0013 says it, computed here once more."""
    return sha256(canonical({name: item[name] for name in FIELDS}))


def all_over(folders: dict[str, Path], centre_url: str, bucket: Path) -> bool:
    """Whether each rig's newest item is at the centre, and each file; without a look into them."""
    there = of_centre(centre_url)
    named: set[str] = set()
    for name, folder in folders.items():
        items = of_rig(folder)
        named |= {item["file"] for item in items if item["file"]}
        if not items or items[-1]["hash"] not in {item["hash"] for item in there.get(name, [])}:
            return False
    return named <= {path.name for path in bucket.rglob("*") if path.is_file()}


def look(folders: dict[str, Path], centre_url: str, bucket: Path) -> Seen:
    """Compare the rigs' outboxes with the centre's items, and each file with its hash."""
    seen, there = Seen(), of_centre(centre_url)
    named: set[str] = set()
    for name, folder in folders.items():
        own, theirs = of_rig(folder), there.get(name, [])
        seen.items_at_rigs += len(own)
        seen.items_at_centre += len(theirs)
        seen.kinds.update(item["kind"] for item in own)
        named |= {item["file"] for item in own if item["file"]}
        hashes = Counter(item["hash"] for item in theirs)
        seen.lost_items += sum(item["hash"] not in hashes for item in own)
        seen.doubled += sum(count - 1 for count in hashes.values())
        seen.doubled += len(set(hashes) - {item["hash"] for item in own})
        seen.wrong_hashes += sum(item_hash(item) != item["hash"] for item in (*own, *theirs))
        seen.out_of_order += _gaps(own) + _gaps(theirs)
    files = [path for path in bucket.rglob("*") if path.is_file() and len(path.name) == 64]
    kept = Counter(path.name for path in files)
    seen.files_at_rigs, seen.files_at_centre = len(named), len(kept)
    seen.lost_files = len(named - set(kept))
    seen.doubled += sum(count - 1 for count in kept.values()) + len(set(kept) - named)
    seen.wrong_hashes += sum(sha256(path.read_bytes()) != path.name for path in files)
    return seen


def _gaps(items: Iterable[dict[str, Any]]) -> int:
    """Items that do not follow the one before, chain by chain."""
    last: dict[str, tuple[int, str]] = {}
    count = 0
    for item in items:
        seq, before = last.get(item["chain"], (0, ZEROS))
        count += (item["seq"], item["previous"]) != (seq + 1, before)
        last[item["chain"]] = (item["seq"], item["hash"])
    return count
