"""What presses of the stop button did, kept for the pages that tell it: loading such a page again stops nothing."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from stimrig.api.errors import ApiError
from stimrig.rig.messages import StopEvidence

KEPT = 200


@dataclass(frozen=True)
class StopResult:
    """One press of the button on a page, and its answer.

    Parameters
    ----------
    right : str or None
        The page's right to stop: the page with the answer carries it on.
    answer : StopEvidence or ApiError
        The rig's evidence, or why the stop is not confirmed.
    """

    by: str
    reason: str
    at_utc: str
    test_id: str | None
    right: str | None
    answer: StopEvidence | ApiError


class StopLog:
    """The newest answers, each under a key that nobody guesses: who pressed may have no session any more."""

    def __init__(self) -> None:
        self._told: dict[str, StopResult] = {}

    def keep(self, told: StopResult) -> str:
        """Keep an answer; its key."""
        while len(self._told) >= KEPT:
            self._told.pop(next(iter(self._told)))
        key = secrets.token_urlsafe(16)
        self._told[key] = told
        return key

    def get(self, key: str) -> StopResult:
        """An answer by its key; 404 where it is kept no longer."""
        told = self._told.get(key)
        if told is None:
            detail = (
                "The service was restarted, or many stops came after this one. The bar above shows what the rig "
                "does now. If it does not say that the rig has stopped, press Stop, or use the "
                "emergency switch on the stimulator. The audit trail lists each stop."
            )
            raise ApiError(404, "not-found", "The result of this stop is no longer kept here", detail)
        return told
