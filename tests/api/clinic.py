"""One participant in a database, with tests and models, and no service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.models.registry import Versions
from stimrig.api.models.tracking import Limits
from stimrig.api.store import Store
from stimrig.api.store.tables import Model, Participant, Recording, Test
from stimrig.identify.errors import BadRequest
from tests.api import stub_worker
from tests.api.conftest import put_database


class Clinic:
    """The database, and what the stub's worker finds."""

    def __init__(self, folder: Path) -> None:
        put_database(folder)
        self.folder, self.store, self.clock = folder, Store(f"sqlite:///{folder}/stimrig.db"), Clock()
        self.versions = Versions(self.store, self.clock)
        self.count = 0
        with self.store.write() as session:
            session.add(Participant(code="P017", profile={}, created_utc=self.clock.utc(), created_by="Ada"))

    def test(self, **plan: Any) -> str:
        """A test that was played, with its recording, whose id is the test's after an R."""
        self.count += 1
        test_id, now = f"T{self.count}", self.clock.utc()
        plan = {"profile": {"current_ma": 20.0}, "side": None, "muscle": None, "placement": None, **plan}
        test = Test(id=test_id, participant="P017", kind="sequence", state="completed", plan=plan, summary={})
        test.requested_by, test.requested_utc, test.recording_id = "Ada", now, f"R{test_id}"
        recording = Recording(id=f"R{test_id}", participant="P017", test_id=test_id, file_sha256="", created_utc=now)
        recording.path = str(self.folder / f"{test_id}.h5")
        with self.store.write() as session:
            session.add_all([test, recording])
        return test_id

    def model(self, effects: tuple[str, ...] = (), test_id: str = "", parent: str | None = None, **plan: Any) -> Model:
        """A version of a test's recording, of a new test without an id."""
        text = json.dumps(stub_worker.model(list(effects)))
        return self.versions.add(text, "P017", f"R{test_id or self.test(**plan)}", "Ada", parent)

    def approve(self, model_id: str, limits: Limits | None = None) -> None:
        self.versions.decide(model_id, True, "Ada", "", limits)

    async def run(self, verb: str, _on_call: Any = None, **arguments: Any) -> dict[str, Any]:
        """What a worker answers."""
        try:
            return stub_worker.VERBS[verb](lambda *_: None, **arguments)
        except BadRequest as error:
            raise ApiError(422, "data", "The data cannot be used", str(error)) from error
