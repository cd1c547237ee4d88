"""The stop: sent to the rig before anything else, then counted, written down and kept for the page that shows it.

A page that shows the button carries a signed right in its form. It allows a stop and nothing else, and asks neither the
database nor a session: it outlives sign-out, the session's end, a new password and a revoked token.
"""

from __future__ import annotations

import asyncio
import base64
import hmac
import json
import logging
import math
import secrets
import time
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics
from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.sessions.rig_client import RigClient
from stimrig.api.store import Store
from stimrig.rig.messages import StopEvidence
from stimrig.rig.requests import StopRequest

log = logging.getLogger("stimrig.trials")
CAPACITY = 200
ANSWER_S = 8.0
NOTE_S = 0.3
"""So long the answer to a stop waits for its entry in the audit trail; the entry is made all the same."""
NOTE_AGAIN_S = (0.5, 1.0, 2.0, 4.0, 8.0, 0.0)  # a database may restart while a stop is written down
BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
NOT_CONFIRMED = "The stop is not confirmed"
EMERGENCY = "Use the stimulator's own emergency switch now."
RIGHT_S = 24 * 3600.0
"""A page's right holds this long, which no session exceeds, and beyond that while the test that it shows is running."""
LONGEST = 1000
disable_created_metrics()


@dataclass(frozen=True)
class StopResult:
    """A stop requested from a page, and its answer."""

    by: str
    reason: str
    at_utc: str
    test_id: str | None
    right: str | None  # the page's right to stop, passed on to the page with the answer
    answer: StopEvidence | ApiError  # the rig's evidence, or why the stop is not confirmed


class Stops:
    """Sends stops. `registry`: how many there were, and how long each took to be confirmed, for `/metrics`."""

    def __init__(self, store: Store, clock: Clock, rig: RigClient) -> None:
        self.store, self.clock, self.rig = store, clock, rig
        self.halted_s = -math.inf
        """When the rig was last stopped, or stopped by itself: a start that was requested before it is not played."""
        self.registry = CollectorRegistry()
        self._count = Counter("stimrig_stops", "Stops by what came of them", ["outcome"], registry=self.registry)
        for outcome in ("confirmed", "not-confirmed", "failed"):  # failed: the rig did not answer
            self._count.labels(outcome)  # exports 0 as well
        self._seconds = Histogram(
            "stimrig_stop_confirmation_seconds", "From the stop's request to the rig's evidence",
            buckets=BUCKETS_S, registry=self.registry,
        )  # fmt: skip
        self._results: dict[str, StopResult] = {}
        self._notes = ThreadPoolExecutor(2, "notes-of-stops")  # its own, which other work cannot exhaust

    async def stop(self, reason: str, by: str, subject: str) -> StopEvidence:
        """Stop the rig; the audit entry comes after, so that nothing delays the command.

        Raises ApiError: 503 the rig cannot be reached, or it could not confirm that stimulation has stopped.
        """
        began_s = self.halted_s = self.clock.monotonic_s()
        try:
            request = StopRequest(reason=reason or "stop pressed", by=by)
            evidence = await self.rig.ask_for(StopEvidence, request, timeout_s=ANSWER_S)
        except ApiError as error:
            self._count.labels("failed").inc()
            await self._note(by, "stop failed", subject, detail=error.detail)
            error.title, error.detail = NOT_CONFIRMED, f"{EMERGENCY} {error.title}: {error.detail}"
            raise
        self._count.labels("confirmed" if evidence.confirmed else "not-confirmed").inc()
        self._seconds.observe(self.clock.monotonic_s() - began_s)
        await self._note(by, "stop", subject, reason=reason, confirmed=evidence.confirmed)
        if not evidence.confirmed:
            detail = f"{EMERGENCY} The rig says: {evidence.detail}"
            raise ApiError(503, "stop-not-confirmed", NOT_CONFIRMED, detail, evidence=evidence.model_dump())
        return evidence

    async def _note(self, by: str, action: str, subject: str, **detail: Any) -> None:
        """Write a stop down; a database that is slow or gone does not keep its answer back."""

        def write() -> None:
            for wait_s in NOTE_AGAIN_S:
                try:
                    return self.store.note(self.clock, by, action, subject, **detail)
                except SQLAlchemyError:
                    log.exception("%s could not yet be written into the audit trail", action)
                time.sleep(wait_s)
            return log.error("%s is not in the audit trail; the rig's journal has it", action)

        await asyncio.wait({asyncio.get_running_loop().run_in_executor(self._notes, write)}, timeout=NOTE_S)

    def add(self, result: StopResult) -> str:
        """Keep an answer for its page and return its key, which nobody guesses: there may be no session any more."""
        while len(self._results) >= CAPACITY:
            self._results.pop(next(iter(self._results)))
        key = secrets.token_urlsafe(16)
        self._results[key] = result
        return key

    def get(self, key: str) -> StopResult:
        """Return an answer by its key. Raises ApiError: 404 no longer kept."""
        if key not in self._results:
            detail = (
                "The bar above shows what the rig does now. If it does not say that the rig has stopped, press Stop, "
                "or use the emergency switch on the stimulator. The audit trail lists each stop."
            )
            raise ApiError(404, "not-found", "The result of this stop is no longer kept here", detail)
        return self._results[key]

    async def close(self) -> None:
        """Finish writing down what was stopped."""
        await asyncio.to_thread(self._notes.shutdown)


class StopRights:
    """Gives rights to stop and verifies them. `key`: of the service; a restart keeps it, so open pages stay good."""

    def __init__(self, key: bytes, clock: Clock) -> None:
        self._key, self.clock = key, clock

    def give(self, name: str, test_id: str | None) -> str:
        """Issue a signed stop right for the page of `name`, which shows this test or none."""
        claims = [name, test_id, round(self.clock.unix_s())]
        words = json.dumps(claims, separators=(",", ":"), ensure_ascii=False).encode()
        return f"{_text(words)}.{_text(self._sign(words))}"

    def holder(self, text: str | None, running: Collection[str | None] = ()) -> str | None:
        """Return the user that the right was issued to; None where it is invalid or has expired."""
        if not text or len(text) > LONGEST or not text.isascii():
            return None
        try:
            words, mark = (base64.urlsafe_b64decode(part + "=" * (-len(part) % 4)) for part in text.split("."))
        except ValueError:
            return None
        if not hmac.compare_digest(mark, self._sign(words)):
            return None
        name, test_id, given_s = json.loads(words)
        young = self.clock.unix_s() - given_s <= RIGHT_S
        return name if young or (test_id is not None and test_id in running) else None

    def _sign(self, words: bytes) -> bytes:
        return hmac.digest(self._key, b"stop\0" + words, "sha256")


def _text(value: bytes) -> str:
    return base64.urlsafe_b64encode(value).decode().rstrip("=")
