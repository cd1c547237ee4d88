"""A rig's data folder: its database, recordings, and sessions written into them."""

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


class Rig:
    """A rig's data folder, and what was written into it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.chance, self.number = folder, random.Random(1), 0
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        put_database(folder)
        self.store = Store(Settings(data_dir=folder).database)

    @property
    def now(self) -> str:
        return Clock().utc()

    def add(self, *rows: Any, action: str = "", subject: str = "x") -> None:
        """Write rows, and an audit entry, in one transaction."""
        with self.store.write() as session:
            for row in rows:
                session.add(row)
                session.flush()
            if action:
                audit.write(session, self.now, "Ada", action, subject)

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
        test_id, number = self.begin_test(code), self.number
        data, path = self.chance.randbytes(1000), self.folder / "recordings" / f"R{number}.h5"
        path.write_bytes(data)
        recording = Recording(id=f"R{number}", participant=code, test_id=test_id, path=str(path), origin="rig")
        recording.file_sha256, recording.created_utc = hashlib.sha256(data).hexdigest(), self.now
        self.add(recording, action="record", subject=recording.id)
        document = json.dumps({"model_id": f"M{number}", "noise": self.chance.random()}).encode()
        model = Model(id=f"M{number}", participant=code, recording_id=recording.id, method="ml", document=document)
        model.effects, model.fit, model.etag = ["fatigue"], {"fit_percent": 97.0}, hashlib.sha256(document).hexdigest()
        model.created_utc, model.created_by = self.now, "test"
        self.add(model, action="store model", subject=model.id)
        with self.store.write() as session:
            row = session.get_one(Test, test_id)
            row.state, row.recording_id, row.model_id, row.finished_utc = "completed", recording.id, model.id, self.now
        decision = Approval(model_id=model.id, participant=code, approved=True, reason="P. said it felt fine", by="Ada")
        decision.at_utc = self.now
        self.add(decision, action="approve", subject=model.id)
        return model


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.store.close()
