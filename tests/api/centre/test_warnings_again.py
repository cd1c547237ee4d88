"""A warning that has come and gone many times is told again once people have acknowledged it."""

from __future__ import annotations

import httpx
import pytest
from sqlalchemy import update

from api.centre import warnings
from api.store.centre_tables import CentreWarning
from tests.api.centre.conftest import Centre


def test_what_was_acknowledged_keeps_no_new_warning_back(
    centre: Centre, rig: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warnings, "MOST_OPEN", 3)
    rig_id, now = centre.row().id, "2026-11-23T08:00:00.000Z"

    def flap(times: int) -> None:
        for _ in range(times):
            with centre.context.store.write() as session:
                warnings.tell(session, now, rig_id, "clock", difference_s=5.0)
                warnings.end(session, now, rig_id, "clock")

    flap(5)
    assert len(centre.warnings()) == 3
    with centre.context.store.write() as session:
        session.execute(update(CentreWarning).values(acknowledged_by="Ada", acknowledged_utc=now))
    flap(1)
    assert centre.warnings() == [("Ward 1", "clock")]
