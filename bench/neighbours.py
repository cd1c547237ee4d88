"""Rig and centre of neighbouring versions: what each rig tells is at each centre, or is kept and told why.

    git worktree add /tmp/old c6ff60e && python -m bench.neighbours /tmp/old [--write]

For each pair a centre and a rig's outbox run as processes of their version, over HTTP. Counted: items and files that
the rig has to tell, and those that the centre has in the end. `--write` records the messages for the suite
(`tests/api/neighbours`): what the old rig sends, and what the old centre answers.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx

from bench.common import ROOT, parser, table, written_by
from tests.harness.upgrades import make_old, make_since, run

KEPT = ROOT / "tests/api/neighbours"
PATIENCE_S = 90.0
TOKEN = secrets.token_urlsafe(24)


@contextlib.contextmanager
def process(tree: Path, module: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A module of a version of the software, until the end of the `with` statement."""
    name = f"stimrig.{module}" if tree == ROOT else module
    given = {**os.environ, **environment, "PYTHONPATH": str(tree)}
    child = subprocess.Popen(
        [sys.executable, "-m", name], env=given, cwd=tree, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield child
    finally:
        child.terminate()
        child.communicate(timeout=60)


@contextlib.contextmanager
def centre(tree: Path, folder: Path) -> Iterator[tuple[str, str]]:
    """A centre; its address and a rig's key."""
    with closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = {"DATA_DIR": str(folder), "PORT": str(port), "ADMIN_TOKEN": TOKEN}
    with process(
        tree, "api.centre.server", {f"STIMRIG_CENTRE_{name}": value for name, value in settings.items()}
    ) as one:
        assert one.stdout is not None
        url = json.loads(one.stdout.readline())["url"]
        head = {"Authorization": f"Bearer {TOKEN}"}
        key = httpx.post(f"{url}/v1/rigs", json={"name": "Ward 1"}, headers=head, timeout=60).json()["key"]
        yield url, key


def rows(database: Path, query: str) -> list[Any]:
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as found:
        return found.execute(query).fetchall()


def told(tree: Path, data: Path, url: str, key: str, at_centre: Path) -> tuple[int, int]:
    """Let the rig's outbox push; the items and files that have arrived when nothing more comes."""
    environment = {"STIMRIG_DATA_DIR": str(data), "STIMRIG_CENTRE_URL": url, "STIMRIG_CENTRE_KEY": key}
    end_s = time.monotonic() + PATIENCE_S
    with process(tree, "api.outbox", environment):
        while time.monotonic() < end_s:
            items, files = arrived(at_centre)
            if (items, files) == waiting(data):
                break
            time.sleep(0.5)
    return arrived(at_centre)


def arrived(database: Path) -> tuple[int, int]:
    found = rows(database, "SELECT (SELECT COUNT(*) FROM centre_items), (SELECT COUNT(*) FROM centre_files)")
    return found[0]


def waiting(data: Path) -> tuple[int, int]:
    """What the rig has to tell, sent or not; none where nothing is written down yet."""
    found = rows(data / "stimrig.db", "SELECT COUNT(*), COUNT(DISTINCT file) FROM outbox")[0]
    return found if found[0] else (-1, -1)


def record(old: Path, place: Path) -> None:
    """Of the last pairs: the old rig's items, and the old centre's answers to a new rig."""
    KEPT.mkdir(exist_ok=True)
    data = place / "old-old/rig/stimrig.db"
    names = ("chain", "seq", "kind", "key", "body", "sha256", "file", "file_bytes", "at_utc", "previous", "hash")
    items = [
        dict(zip(names, row, strict=True)) for row in rows(data, f"SELECT {', '.join(names)} FROM outbox ORDER BY id")
    ]
    chain = items[0]["chain"]
    sent = [{**item, "body": json.loads(item["body"])} for item in items]
    for item in sent:
        del item["chain"]
    batch = {"chain": chain, "items": sent}
    (KEPT / "old_rig.json").write_text(json.dumps(batch, indent=1, ensure_ascii=False) + "\n", "utf-8")
    with (
        centre(old, place / "answers") as (url, key),
        httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=60) as http,
    ):
        hello = {"chain": chain, "seq": 0, "hash": "0" * 64, "utc": "2026-11-23T10:00:00.000Z", "version": "1.0"}
        found = {
            "POST /v1/rig/hello": http.post("/v1/rig/hello", json=hello),
            "POST /v1/rig/items": http.post("/v1/rig/items", json=batch),
            "GET /v1/rig/files": http.get("/v1/rig/files"),
            "GET /v1/rig/heads": http.get("/v1/rig/heads"),
        }
        answers = {name: {"status": one.status_code, "json": one.json()} for name, one in found.items()}
    (KEPT / "old_centre.json").write_text(json.dumps(answers, indent=1) + "\n", "utf-8")


def main() -> int:
    made = parser(__doc__)
    made.add_argument("old", type=Path, help="a working tree of c6ff60e")
    made.add_argument("--write", action="store_true", help="record the messages for the suite")
    asked = made.parse_args()
    trees, lines, lacking = {"old": asked.old.resolve(), "new": ROOT}, [], 0
    with tempfile.TemporaryDirectory(prefix="stimrig-neighbours-") as folder:
        for rig, rig_tree in trees.items():
            for at, centre_tree in trees.items():
                place = Path(folder) / f"{rig}-{at}"
                make_old(place / "rig", 2, 2)
                if rig == "new":
                    run(place / "rig", back=False)
                    make_since(place / "rig", 0, new=True)
                with centre(centre_tree, place / "centre") as (url, key):
                    items, files = told(rig_tree, place / "rig", url, key, place / "centre/centre.db")
                told_of = waiting(place / "rig")
                lacking += (items, files) != told_of
                lines.append((rig, at, *told_of, items, files))
        if asked.write:
            record(asked.old.resolve(), Path(folder))
    print(written_by("python -m bench.neighbours OLD"))
    print("\n".join(table(("rig", "centre", "items", "files", "items arrived", "files arrived"), lines)))
    return int(lacking > 0)


if __name__ == "__main__":
    raise SystemExit(main())
