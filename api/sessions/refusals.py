"""Why a test is not begun, and who answers for one that is."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from stimrig.api.errors import ApiError
from stimrig.api.people import names
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store import seen
from stimrig.api.store.tables import AuditEntry, Participant


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
    tokens: list[str] = field(default_factory=list)
    """Hashes of the tokens by whose right it is played."""
    until_utc: str | None = None
    """When that right ends by itself: a controller's key with its day, or with its maker's token."""
    since: seen.Seen | None = None
    """The trail's place at its intent, or at the last change that was found; None: not written yet."""
    over: bool = False
    """That end was told to the rig."""
    overtaken: list[AuditEntry] = field(default_factory=list)
    """Changes that have withdrawn it."""
    looking: asyncio.Lock = field(default_factory=asyncio.Lock)
    missed: int = 0
    """How often in a row the rig, asked for its state, did not name it."""
    let_go: asyncio.Event = field(default_factory=asyncio.Event)
    """The rig is free of it."""

    @property
    def rests_on(self) -> tuple[seen.About, ...]:
        """Entries of the audit trail, since its intent, with which it would not have been begun."""
        return (*rests_of(self.participant, self.kind), seen.revoked(*self.tokens))


def rests_of(participant: str, kind: str) -> tuple[seen.About, ...]:
    """What must have been seen of a test: the participant, and of a controller's trial the decisions on models."""
    models = (seen.decisions(participant),) if kind == SEQUENCE else ()
    return (seen.participant(participant), *models)


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


def right_ended() -> ApiError:
    """409: by whose right it was asked for may do so no more."""
    detail = (
        "A controller's key ends with its day or its maker's token, and a right when it is revoked. Nothing was sent."
    )
    return ApiError(409, "changed-meanwhile", "The right to this test has ended", detail)


def not_what_was_seen() -> ApiError:
    """409: a person said yes to something else."""
    detail = "The rig would now play something else: it was set up anew. Nothing was started. Go back and check."
    return ApiError(409, "changed-meanwhile", "This page is out of date", detail)


def busy(current: Current) -> ApiError:
    """409, naming the holder."""
    who = current.by
    detail = (
        f"{current.test_id} for participant {current.participant}, started by {who}, uses the rig. "
        "Wait for its end, or stop it."
    )
    holder = {"test_id": current.test_id, "participant": current.participant, "by": current.by}
    return ApiError(409, "rig-busy", "Another test is running", detail, holder=holder)
