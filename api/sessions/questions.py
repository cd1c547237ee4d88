"""What a person is asked before an action that matters: bound to exactly what is shown, once, for five minutes.

A question is kept here and not in the page, so that nothing but its answer comes back: a form gone stale, a second
click, *Back* or a reload cannot make the action another one, or do it twice.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError
from stimrig.api.people.auth import Principal
from stimrig.api.store import locking

LIFE_S = 300.0
"""How long what was seen may be confirmed."""
REMEMBERED_S = 3600.0
"""How long an answered one still leads to what came of it."""
MOST = 20
"""Open questions of one person; older ones are dropped."""


@dataclass(frozen=True)
class Row:
    """One line of what is shown: what, its value, and what it was before where it changes."""

    label: str
    value: str
    before: str = ""


@dataclass
class Question:
    """What is shown, and what is done when a person says yes."""

    participant: str  # whom it is about; also its place among the addresses
    title: str  # the question
    button: str  # what the button says that means yes
    action: Callable[[], Awaitable[str]]  # does it; gives the address that it leads to
    rows: list[Row] = field(default_factory=list)  # what it is bound to, in words
    warnings: list[str] = field(default_factory=list)  # what deserves a second look
    stimulates: bool = False  # whether current flows on yes
    back: str = ""  # where no leads to; the participant where nothing is said
    at_deg: tuple[float, float] | None = None  # the joint must be between these angles when yes is said
    asker: tuple[str, str | None] = ("", None)
    tags: locking.Tags | None = None
    asked_s: float = 0.0
    asked_unix_s: float = 0.0
    answer: asyncio.Future[str] | None = None


class Questions:
    """The open ones, and those answered not long ago. A restart forgets them: then a person is asked again."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._all: dict[str, Question] = {}

    def ask(self, question: Question, who: Principal) -> str:
        """Keep it; the address at which it is shown and answered."""
        question.asker, question.tags = (who.name, who.csrf), locking.form_tags.get()
        question.asked_s, question.asked_unix_s = self.clock.monotonic_s(), self.clock.unix_s()
        self._forget(question)
        number = secrets.token_urlsafe(16)
        self._all[number] = question
        return f"/participants/{question.participant}/confirm/{number}"

    async def ask_if_doubtful(self, question: Question, who: Principal) -> str:
        """Do it where nothing deserves a second look, else ask; the address that it leads to."""
        return self.ask(question, who) if question.warnings else await question.action()

    def _forget(self, new: Question) -> None:
        old = [name for name, known in self._all.items() if not (new.asked_s - known.asked_s <= REMEMBERED_S)]
        mine = [name for name, known in self._all.items() if known.asker == new.asker]
        for name in {*old, *mine[: -MOST + 1]}:
            del self._all[name]

    def find(self, participant: str, number: str, who: Principal) -> Question:
        """One that may still be answered by this person, or has been.

        Raises ApiError: 410 not asked, asked of somebody else, or too long ago.
        """
        found = self._all.get(number)
        if found is None or found.participant != participant or found.asker != (who.name, who.csrf):
            raise gone("It was shown to another person, or before the service was restarted.")
        if found.answer is None and not self._fresh(found):
            raise gone(f"It is valid for {LIFE_S / 60:.0f} minutes; what it shows may have changed.")
        return found

    def _fresh(self, question: Question) -> bool:
        """By both clocks: one stands still while the machine sleeps, the other may be set."""
        passed_s = self.clock.monotonic_s() - question.asked_s
        by_the_wall_s = self.clock.unix_s() - question.asked_unix_s
        return 0 <= passed_s <= LIFE_S and 0 <= by_the_wall_s <= LIFE_S

    async def yes(self, question: Question) -> str:
        """Do it, once; who says yes again comes to what came of it."""
        if question.answer is None:
            locking.form_tags.set(question.tags)
            question.answer = asyncio.ensure_future(question.action())
        return await asyncio.shield(question.answer)


def gone(why: str) -> ApiError:
    """410: there is nothing to be answered any more."""
    return ApiError(410, "too-late", "This question is closed", f"{why} Nothing was done. Go back and start again.")
