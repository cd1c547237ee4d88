"""A decision about a participant: who makes it, on which versions, and what they have confirmed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.store.locking import Tags


@dataclass(frozen=True)
class Change:
    """One line of a confirmation: what changes, from what to what; `before` is empty where nothing was there."""

    what: str
    now: str
    before: str = ""


@dataclass(frozen=True)
class Decision:
    """Decider, versions and confirmation token of a decision; `on_page`: a person signed in decides."""

    by: str
    tags: Tags
    confirm: str = ""
    on_page: bool = False

    def require_confirmation(
        self, version: int, title: str, button: str, changes: Sequence[Change], warnings: Sequence[str],
        code: str = "confirm",
    ) -> None:  # fmt: skip
        """Ask before what deserves a second look: 409, unless `confirm` is the token of this very question.

        The token holds for this person, this question and the participant's present `version`. The problem's `confirm`
        holds `title`, `button`, `rows`, `warnings` and `token`, which is sent back as `?confirm=TOKEN`.
        """
        rows = [asdict(change) for change in changes]
        question: dict[str, Any] = {"title": title, "button": button, "rows": rows, "warnings": list(warnings)}
        text = json.dumps([question, self.by, version], sort_keys=True)
        token = hashlib.sha256(text.encode()).hexdigest()[:16]
        if self.confirm != token:
            detail = f"{' '.join(warnings)} To do it all the same, send it again with ?confirm={token}."
            raise ApiError(409, code, title, detail, confirm={**question, "token": token})
