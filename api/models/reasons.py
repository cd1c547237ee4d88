"""A reason that is a reason: asked of whoever lets a controller have a model that is not usable."""

from __future__ import annotations

import re

from api.errors import ApiError

POOR = ("not usable", "unknown")
"""The verdicts with which an approval needs a reason."""
WORDS, LETTERS, DIFFERENT = 3, 10, 5
"""So many different words, so many letters, so many different letters; "ok", "asdf" and "......" have fewer."""
WHAT_TO_WRITE = (
    "Write in a few words why the controller may have this model and who watches it, "
    "for example: only the delay is used today, the engineer stands by."
)
_WORD = re.compile(r"[^\W\d_]+")
_REPEATED = re.compile(r"(.)\1{3}")


def is_reason(text: str) -> bool:
    """Whether a text says something: a few different words, none of them one letter held down."""
    words = [word.casefold() for word in _WORD.findall(text)]
    letters = "".join(words)
    return (
        len(set(words)) >= WORDS
        and len(letters) >= LETTERS
        and len(set(letters)) >= DIFFERENT
        and not any(_REPEATED.search(word) for word in words)
    )


def refuse_without(verdict: str, reason: str) -> None:
    """Refuse to approve a model that is not usable without a reason.

    Raises
    ------
    ApiError
        422: what to write.
    """
    if verdict in POOR and not is_reason(reason):
        raise ApiError(
            422,
            "reason-needed",
            "This model is not usable: say why it is approved all the same",
            f"{WHAT_TO_WRITE} Nothing was decided.",
        )
