"""Why a test is not begun, and who answers for one that is."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from api.errors import ApiError
from api.people import names
from api.store.tables import Participant


@dataclass
class Current:
    """The test the rig is busy with, or that is being identified."""

    test_id: str
    participant: str
    by: str
    kind: str = ""
    """Of the test."""
    started: bool = False
    """The rig has said that it plays."""
    ending: bool = False
    """Its end has been heard."""
    missed: int = 0
    """How often in a row the rig, asked for its state, did not name it."""
    let_go: asyncio.Event = field(default_factory=asyncio.Event)
    """The rig is free of it."""


def other_than(asker: str, ran_by: str | None) -> str | None:
    """Who ran a test, where that was not who asked for it."""
    return ran_by if ran_by and names.folded(ran_by) != names.folded(asker) else None


def refuse_archived(participant: Participant) -> None:
    """409: nothing is begun with a participant in the archive."""
    if participant.archived_utc is not None:
        detail = (
            f"{participant.code} is in the archive. Take it out first: on its page, or by "
            f"POST /v1/participants/{participant.code}/unarchive. Nothing was started."
        )
        raise ApiError(409, "archived", "This participant is archived", detail)


def not_what_was_seen(why: str) -> ApiError:
    """409: a person said yes to something else."""
    return ApiError(
        409, "not-what-was-seen", "This page is out of date", f"{why} Nothing was started. Go back and check."
    )


def busy(current: Current) -> ApiError:
    """409, naming the holder."""
    detail = (
        f"{current.test_id} for participant {current.participant}, started by {current.by}, uses the rig. "
        "Wait for its end, or stop it."
    )
    holder = {"test_id": current.test_id, "participant": current.participant, "by": current.by}
    return ApiError(409, "rig-busy", "Another test is running", detail, holder=holder)
