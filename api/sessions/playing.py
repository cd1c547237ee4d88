"""The one test that this service has the rig play: who answers for it, and whether it may still be played."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people import accounts
from stimrig.api.people.auth import Scope
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store import Store, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Participant, Token
from stimrig.rig.requests import StopRequest, WithdrawRequest

log = logging.getLogger("stimrig.trials")
ENDING_S = 2.0
"""So long a start waits for a test whose end has been heard."""
RIGHTS = (*locking.MODELS, "set muscle")
"""Changes with which a right ends that a controller plays by."""
LOOK_AGAIN_S = 0.25
"""Interval at which it is checked whether a test may still be played: a right may end by time."""


@dataclass(frozen=True)
class Requester:
    """Requester of a test, and the versions that they decided it on."""

    name: str
    token: str = ""
    """Hash of the token by whose right it is begun."""
    tags: Tags | None = None
    """Versions of the participant."""
    model: str = ""
    """Tag of the model that a controller's trial was planned with."""


@dataclass
class Current:
    """The test that the rig plays or that is being identified."""

    test_id: str
    participant: str
    by: str
    kind: str = ""
    started: bool = False
    """The rig has said that it plays."""
    ending: bool = False
    """The rig has reported its end."""
    tokens: list[str] = field(default_factory=list)
    """Hashes of the tokens by whose right it is played."""
    until_utc: str | None = None
    """When that right ends by itself: a controller's key with its day, or with its maker's token."""
    version: int | None = None
    """The participant's at its intent, or at the last change that was found; None: not written yet."""
    over: bool = False
    """The end of the right was told to the rig."""
    changes: list[dict[str, Any]] = field(default_factory=list)
    """Those of the participant that have withdrawn it."""
    state_lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    missed: int = 0
    """Number of consecutive rig states that did not name it."""
    let_go: asyncio.Event = field(default_factory=asyncio.Event)
    """The rig is free of it."""

    @property
    def holder(self) -> dict[str, str]:
        """Return the holder of the rig, for problems and the rig's document."""
        return {"test_id": self.test_id, "participant": self.participant, "by": self.by}


class Playing:
    """The current test, and whether it may still be played."""

    def __init__(self, store: Store, clock: Clock, rig: RigClient) -> None:
        self.store, self.clock, self.rig = store, clock, rig
        self.current: Current | None = None

    def plays(self, test_id: str | None) -> bool:
        """Return whether the rig plays this test."""
        current = self.current
        return current is not None and current.test_id == test_id and current.started and not current.ending

    def refuse_second(self) -> None:
        """409 while a test runs, its holder named."""
        if (current := self.current) is not None:
            test = f"{current.test_id} for participant {current.participant}, started by {current.by},"
            detail = f"{test} uses the rig. Wait for its end, or stop it."
            raise ApiError(409, "rig-busy", "Another test is running", detail, holder=current.holder)

    async def let_end(self) -> None:
        """A test is seen to be done a moment before the rig is let go: who starts the next one then is not refused."""
        if self.current is not None and self.current.ending:
            with suppress(TimeoutError):
                await asyncio.wait_for(self.current.let_go.wait(), ENDING_S)

    def find_changes(self, current: Current) -> tuple[int | None, list[dict[str, Any]], bool]:
        """Return the participant's version, its changes since the test's intent, and whether a right has ended."""
        if current.version is None:
            return None, [], False
        with self.store.read() as session:
            lost = any(not may_play(session.get(Token, each)) for each in current.tokens)
            row = session.get(Participant, current.participant)
            if row is None or row.version == current.version:
                return current.version, [], lost
            return row.version, locking.since(session, current.version, locking.about(row)), lost

    async def look_again(self) -> None:
        """Withdraw the test if what it rests on was changed: called before each change is answered.

        A test that has not begun plays no pulse; a controller's trial whose right has ended ends at once. Where the rig
        does not take that, it is stopped, and asked again.
        """
        if (current := self.current) is None:
            return
        async with current.state_lock:
            version, changes, lost = current.version, list[dict[str, Any]](), self.is_over(current)
            if not lost:  # expiry is known here even where the store cannot be read
                version, changes, lost = await asyncio.to_thread(self.find_changes, current)
            ended = lost and not current.over
            if version is None:  # its intent was not written yet; one written since then uses the current version
                version = current.version
            if version == current.version and not ended:
                return
            current.changes = changes or current.changes
            begun = current.kind == SEQUENCE and (ended or any(change["action"] in RIGHTS for change in changes))
            what = changes[-1]["action"] if changes else "its right ended" if ended else "the participant was changed"
            reason = f"{what}, after this test was asked for"
            try:
                await self.rig.ask(WithdrawRequest(test_id=current.test_id, reason=reason, begun=begun))
            except ApiError as error:
                log.error("%s could not be withdrawn: %s", current.test_id, error)
                await self.stop_quietly(f"{current.test_id} could not be withdrawn: {reason}")
            else:
                current.version, current.over = version or current.version, current.over or ended

    async def look_again_and_again(self, current: Current) -> None:
        """Check at intervals whether it may still be played: a right ends by time, too, and no request says so."""
        while self.current is current and not current.ending:
            await asyncio.sleep(LOOK_AGAIN_S)
            try:
                await self.look_again()
            except Exception:
                log.exception("whether %s may still be played could not be seen", current.test_id)

    async def stop_quietly(self, reason: str) -> None:
        """Stop the rig; whether it could is only noted."""
        try:
            await self.rig.ask(StopRequest(reason=reason, by="service"))
        except ApiError as error:
            log.warning("stop after a failed start: %s", error)

    def is_over(self, current: Current) -> bool:
        """Return whether the right to play it has expired."""
        return current.until_utc is not None and current.until_utc <= self.clock.utc()

    def until_utc(self, tokens: list[str]) -> str | None:
        """When the key ends by whose right a test is played, with its maker's; a person's may end before the test."""
        rows = [row for token in tokens if (row := self.store.get(Token, token)) is not None]
        by_key = any(row.participant for row in rows)
        return min((row.expires_utc for row in rows if by_key and row.expires_utc), default=None)

    def tokens_of(self, holder: str) -> list[str]:
        """Hashes of the tokens by whose right a test is played: the asker's, and that of who made a key."""
        row: Token | None = self.store.get(Token, holder) if holder else None
        return [token for token in (holder, row.made_by if row else None) if token]


def may_play(token: Token | None) -> bool:
    """Return whether who asked, or made the key that asks, still has the right: it may have been taken since."""
    return token is not None and not token.revoked and bool({Scope.RUN_TEST, Scope.ADMINISTER} & set(token.scopes))


def other_than(asker: str, ran_by: str | None) -> str | None:
    """Return who ran a test, where that is not the requester."""
    return ran_by if ran_by and accounts.folded_name(ran_by) != accounts.folded_name(asker) else None


def right_ended() -> ApiError:
    """Return the 409 for a requester whose right has ended."""
    detail = (
        "A controller's key ends with its day or its maker's token, and a right when it is revoked. Nothing was sent."
    )
    return ApiError(409, "changed-meanwhile", "The right to this test has ended", detail)
