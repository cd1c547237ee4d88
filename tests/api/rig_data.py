"""A rig's data folder on a virtual clock: database, recordings, and days of work written into them."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stimrig.api.clock import Clock
from stimrig.api.settings import Settings
from stimrig.api.store import Store, audit
from stimrig.api.store.tables import Approval, Model, Participant, Recording, Test
from tests.api.conftest import put_database


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
    """A rig's data folder, and what was written into it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.chance = folder, random.Random(1)
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        self.clock = VirtualClock()
        put_database(folder)
        self.store = Store(Settings(data_dir=folder).database)
        self.number = 0

    @property
    def now(self) -> str:
        return self.clock.utc()

    def add(self, *rows: Any, action: str = "", subject: str = "x") -> None:
        """Write rows, and an audit entry, in one transaction."""
        with self.store.write() as session:
            for row in rows:
                session.add(row)
                session.flush()
            if action:
                audit.write(session, self.clock.utc(), "Ada", action, subject)

    def begin_test(self, code: str) -> str:
        if self.store.get(Participant, code) is None:
            row = Participant(code=code, profile={"current_ma": 20.0}, created_utc=self.now, created_by="Ada")
            self.add(row, action="create participant", subject=code)
        self.number += 1
        plan = {"kind": "identification", "preview": {"duration_s": 30.0, "pulse_width_us": [1.0] * 1000}}
        row = Test(id=f"T{self.number}", participant=code, kind="identification", state="requested", plan=plan)
        row.summary, row.reason, row.requested_by, row.requested_utc = {}, "", "Ada", self.now
        self.add(row, action="start test", subject=row.id)
        return row.id

    def session(self, code: str) -> Model:
        """A test with its recording, its model and a decision on it."""
        test_id = self.begin_test(code)
        self.clock.sleep(30)
        recording = self._recording(code, test_id)
        model = self._model(recording)
        with self.store.write() as session:
            row = session.get(Test, test_id)
            assert row is not None
            row.state, row.recording_id, row.model_id, row.finished_utc = "completed", recording.id, model.id, self.now
        decision = Approval(model_id=model.id, participant=code, approved=True, reason="P. said it felt fine", by="Ada")
        decision.at_utc = self.now
        self.add(decision, action="approve", subject=model.id)
        return model

    def _recording(self, code: str, test_id: str) -> Recording:
        self.number += 1
        data = self.chance.randbytes(1000)
        path = self.folder / "recordings" / f"R{self.number}.h5"
        path.write_bytes(data)
        row = Recording(id=f"R{self.number}", participant=code, test_id=test_id, path=str(path), origin="rig")
        row.file_sha256, row.created_utc = hashlib.sha256(data).hexdigest(), self.now
        self.add(row, action="record", subject=row.id)
        return row

    def _model(self, recording: Recording) -> Model:
        self.number += 1
        document = json.dumps({"model_id": f"M{self.number}", "noise": self.chance.random()}).encode()
        row = Model(id=f"M{self.number}", participant=recording.participant, recording_id=recording.id, method="ml")
        row.effects, row.fit, row.document = ["fatigue"], {"fit_percent": 97.0}, document
        row.etag = hashlib.sha256(document).hexdigest()
        row.created_utc, row.created_by = self.now, "test"
        self.add(row, action="store model", subject=row.id)
        return row


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.store.close()
