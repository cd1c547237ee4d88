"""A rig's store with a feed and a pusher on a virtual clock, and days of work to be told."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stimrig.api.clock import Clock
from stimrig.api.outbox.feed import Feed
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.pusher import POLL_S, Pusher
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Approval, Model, OutboxItem, Participant, Recording, Test, Tracked
from tests.api.conftest import put_database
from tests.harness.fake_centre import KEY, FakeCentre, canonical, sha256

URL = "https://centre.example.org"
ZEROS = "0" * 64
QUIET_S = 10.0


class VirtualClock(Clock):
    """Time goes on where somebody sleeps."""

    def __init__(self) -> None:
        self.now_s = 1_790_000_000.0

    def unix_s(self) -> float:
        return self.now_s

    def monotonic_s(self) -> float:
        return self.now_s - 1_780_000_000.0

    def sleep(self, wait_s: float) -> None:
        self.now_s += wait_s


class Rig:
    """A rig's data folder: database, recordings, and what was written into them."""

    def __init__(self, folder: Path, *, feed: bool = True, seed: int = 1) -> None:
        self.folder, self.chance = folder, random.Random(seed)
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        self.settings = Settings(data_dir=folder, database_url=None, centre_url=URL, centre_key=KEY)  # pyright: ignore[reportArgumentType]
        self.clock = VirtualClock()
        put_database(folder)
        self.store = Store(self.settings.database)
        self.number = 0
        if feed:
            Feed(self.store, self.clock)

    def close(self) -> None:
        self.store.close()

    # ---- work ----------------------------------------------------------------------------------------------------

    def add(self, *rows: Any, action: str = "", subject: str = "x") -> None:
        """Write rows, and an audit entry, in one transaction."""
        with self.store.write() as session:
            for row in rows:
                session.add(row)
                session.flush()
            if action:
                audit.write(session, self.clock.utc(), "Ada", action, subject)

    def participant(self, code: str) -> Participant:
        row = Participant(code=code, profile={"current_ma": 20.0}, created_utc=self.clock.utc(), created_by="Ada")
        self.add(row, action="create participant", subject=code)
        return row

    def known(self, code: str) -> None:
        """The participant is there."""
        if self.store.get(Participant, code) is None:
            self.participant(code)

    def begin_test(self, code: str) -> str:
        self.known(code)
        self.number += 1
        plan = {"kind": "identification", "preview": {"duration_s": 30.0, "pulse_width_us": [1.0] * 1000}}
        row = Test(id=f"T{self.number}", participant=code, kind="identification", state="requested", plan=plan)
        row.summary, row.reason, row.requested_by, row.requested_utc = {}, "", "Ada", self.clock.utc()
        self.add(row, action="start test", subject=row.id)
        return row.id

    def recording(self, code: str, test_id: str | None = None, size: int = 1000) -> Recording:
        self.known(code)
        self.number += 1
        data = self.chance.randbytes(size)
        path = self.folder / "recordings" / f"R{self.number}.h5"
        path.write_bytes(data)
        row = Recording(id=f"R{self.number}", participant=code, test_id=test_id, path=str(path), origin="rig")
        row.file_sha256, row.created_utc = sha256(data), self.clock.utc()
        self.add(row, action="record", subject=row.id)
        return row

    def model(self, recording: Recording) -> Model:
        self.number += 1
        document = json.dumps({"model_id": f"M{self.number}", "noise": self.chance.random()}).encode()
        row = Model(id=f"M{self.number}", participant=recording.participant, recording_id=recording.id, method="ml")
        row.effects, row.fit, row.document, row.etag = ["fatigue"], {"fit_percent": 97.0}, document, sha256(document)
        row.created_utc, row.created_by = self.clock.utc(), "test"
        self.add(row, action="store model", subject=row.id)
        return row

    def session(self, code: str, size: int = 1000) -> Model:
        """A test with its recording, its model and a decision on it."""
        test_id = self.begin_test(code)
        self.clock.sleep(30)
        recording = self.recording(code, test_id, size)
        model = self.model(recording)
        with self.store.write() as session:
            row = session.get(Test, test_id)
            assert row is not None
            row.state, row.recording_id, row.model_id, row.finished_utc = "completed", recording.id, model.id, self.now
        decision = Approval(model_id=model.id, participant=code, approved=True, reason="P. said it felt fine", by="Ada")
        decision.at_utc = self.now
        self.add(decision, action="approve", subject=model.id)
        return model

    def tracked(self, model: Model) -> Tracked:
        test_id = self.begin_test(model.participant)
        approval = self.store.all(Approval, Approval.model_id == model.id)[0]
        document = b'{"served": 1}'
        row = Tracked(test_id=test_id, approval_id=approval.id, participant=model.participant, model_id=model.id)
        row.number, row.outcome, row.document, row.etag, row.at_utc = 1, "moved", document, sha256(document), self.now
        self.add(row, action="track model", subject=model.id)
        return row

    @property
    def now(self) -> str:
        return self.clock.utc()

    # ---- telling -------------------------------------------------------------------------------------------------

    def pusher(self, line: Callable[[httpx.Request], httpx.Response] | httpx.BaseTransport, seed: int = 1) -> Pusher:
        transport = line if isinstance(line, httpx.BaseTransport) else httpx.MockTransport(line)
        link = Link(URL, KEY, self.clock, transport)
        return Pusher(self.store, self.settings, self.clock, link, self.clock.sleep, random.Random(seed))

    def items(self) -> list[OutboxItem]:
        return self.store.all(OutboxItem, order=OutboxItem.id)

    def told(self) -> list[tuple[str, str]]:
        return [(item.kind, item.key) for item in self.items()]


def run(pusher: Pusher, for_s: float) -> None:
    """Let it work for a virtual while. Nobody else writes meanwhile, so in a long one it need not look each second."""
    clock = pusher.clock
    assert isinstance(clock, VirtualClock)
    end = clock.now_s + for_s
    turns = 0
    while clock.now_s < end:
        wait_s = pusher.turn()
        pusher.sleep(QUIET_S if wait_s == POLL_S and clock.now_s + 2 * QUIET_S < end else wait_s)
        turns += 1
        assert turns < 10_000 + 10 * for_s, "it turns without waiting"


def assert_chain(items: list[dict[str, Any]]) -> None:
    """One chain: no gap, each hash right; computed here from the decision."""
    previous = ZEROS
    for number, item in enumerate(items, 1):
        assert item["seq"] == number and item["previous"] == previous
        fields = ("seq", "kind", "key", "sha256", "file", "file_bytes", "at_utc", "previous")
        assert hashlib.sha256(canonical({name: item[name] for name in fields})).hexdigest() == item["hash"]
        body = item["body"] if isinstance(item["body"], dict) else json.loads(item["body"])
        assert sha256(canonical(body)) == item["sha256"]
        previous = item["hash"]


def assert_told(rig: Rig, centre: FakeCentre) -> None:
    """What the rig has is there: nothing lost, nothing doubled, in order, every file whole."""
    own = [item for item in rig.items() if item.chain == rig.items()[-1].chain]
    there = centre.chains[own[-1].chain]
    assert [item["hash"] for item in there] == [item.hash for item in own]
    assert_chain(there)
    named = {item.file for item in own if item.file is not None}
    assert named == set(centre.files)
    assert all(sha256(data) == digest for digest, data in centre.files.items())


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()
