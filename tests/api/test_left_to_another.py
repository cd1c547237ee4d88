"""A service that another one thought dead: what it was doing does not end in a second model of one recording."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from api.clock import Clock
from api.sessions.following import Follower
from api.sessions.lifecycle import Lifecycle
from api.store import Store
from api.store.holds import Alone
from api.store.tables import Model, Participant, Recording, Test


def store_with_a_test(folder: Path, followed_by: str) -> Store:
    store, now = Store(f"sqlite:///{folder / 'stimrig.db'}"), "2026-11-23T08:00:00.000Z"
    rows: list[Any] = [
        Participant(code="P1", profile={}, created_utc=now, created_by="Ada"),
        Test(
            id="T1", participant="P1", kind="identification", state="identifying", plan={}, summary={}, reason="",
            requested_by="Ada", requested_utc=now, followed_by=followed_by,
        ),
        Recording(id="R1", participant="P1", test_id="T1", path="r.h5", file_sha256="", origin="rig", created_utc=now),
    ]  # fmt: skip
    with store.write() as session:
        for row in rows:
            session.add(row)
            session.flush()
        rows[1].recording_id = "R1"
    return store


@pytest.mark.parametrize("taken_up", [False, True])
def test_a_test_that_was_taken_up_during_the_fit_is_left_to_who_did(tmp_path: Path, taken_up: bool) -> None:
    holds, added = Alone(), []
    store = store_with_a_test(tmp_path, holds.me)

    async def fit(*_given: Any, **_how: Any) -> tuple[dict[str, str], str]:
        if taken_up:
            with store.write() as session:
                session.get_one(Test, "T1").followed_by = "another"
        return {"json": "{}"}, ""

    async def carry(model: Model, *_given: Any, **_how: Any) -> Model:
        return model

    def add(_json: str, participant: str, recording_id: str, by: str, _parent: str | None) -> Model:
        row = Model(id=f"M{len(added)}", participant=participant, recording_id=recording_id, method="ml")
        row.document, row.etag = b"{}", "0" * 64
        row.effects, row.fit, row.created_utc, row.created_by = [], {}, "2026-11-23T08:00:00.000Z", by
        with store.write() as session:
            session.add(row)
        added.append(row)
        return row

    async def diagnose_ahead(_model: Model) -> None: ...

    carried = SimpleNamespace(fit=fit, carry=carry)
    analyses: Any = SimpleNamespace(carried_structure=carried, diagnose_ahead=diagnose_ahead)
    nothing: Any = SimpleNamespace(fit_options=lambda _row: {}, add=add)
    follower = Follower(store, holds, "rig")
    lifecycle = Lifecycle(
        store, Clock(), nothing, nothing, nothing, analyses, nothing, nothing, tmp_path, follower, lambda _test_id: None
    )
    asyncio.run(lifecycle.identify("T1"))
    row = store.get(Test, "T1")
    assert (len(added), row.state) == ((0, "identifying") if taken_up else (1, "completed"))
    store.close()
