"""Reasons: asked of whoever lets a controller have a model that is not usable, told to whoever adds an effect."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from stimrig.api.errors import ApiError

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


def require_evidence(diagnosis: dict[str, Any], present: Sequence[str], added: Sequence[str]) -> None:
    """Refuse effects that the recording does not ask for.

    Raises
    ------
    ApiError
        409, with the reason for each effect.
    """
    reasons = {effect: refusal(diagnosis, present, effect) for effect in added}
    found = {effect: reason for effect, reason in reasons.items() if reason}
    if found:
        detail = " ".join(f"{effect}: {reason}" for effect, reason in found.items())
        detail += (
            " To add it against the evidence, send `force` and a reason; the held-out error then shows its effect."
        )
        raise ApiError(
            409, "effect-not-there", "The recording gives no evidence for this effect", detail, reasons=found
        )


def refusal(diagnosis: dict[str, Any], present: Sequence[str], effect: str) -> str | None:
    """Why the recording does not ask for an effect; None where it does, or cannot tell it from one it asks for."""
    for entry in diagnosis.get("missing") or []:
        if entry["effect"] == effect:
            return None
        if effect in (entry.get("confused_with") or []) and entry["effect"] not in present:
            return None
    rows = [row for rows in diagnosis.get("candidates") or [] for row in rows if row["effect"] == effect]
    if not rows:
        return "it was not tested on this recording: the recording lacks the columns that it needs."
    gain = rows[-1]["log_evidence_gain"]
    if gain <= 0:
        return f"the recording speaks against it (log evidence {gain:+.1f})."
    better = [entry for entry in diagnosis.get("missing") or [] if entry["effect"] != effect]
    if better and rows[0]["log_evidence_gain"] > 6:
        names = " and ".join((entry.get("name") or entry["effect"]).lower() for entry in better)
        name = ((diagnosis.get("library") or {}).get(effect) or {}).get("name", effect).lower()
        beside = f"with it in the model, {name} gains too little (log evidence {gain:+.1f})."
        return f"{names} explains the same error better; {beside}"
    return f"the evidence is too weak (log evidence {gain:+.1f}): what it explains looks like noise."
