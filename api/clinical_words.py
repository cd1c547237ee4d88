"""What pages call things that programs call otherwise: a clinician's word first, the technical term one hover away."""

from __future__ import annotations

from typing import Any

from api.language import _, lazy

SEGMENTS: dict[str, Any] = {
    "rest": lazy("Rest"),
    "prbs": lazy("Random pulses"),
    "ramp": lazy("Ramp"),
    "validate": lazy("Check (not used for fitting)"),
}
VERDICTS: dict[str, Any] = {
    "usable": lazy("usable"),
    "usable with care": lazy("usable with care"),
    "not usable": lazy("not usable"),
    "unknown": lazy("unknown"),
}
TEST_KINDS: dict[str, Any] = {
    "pre-session": lazy("pre-session test"),
    "next-experiment": lazy("next experiment"),
    "sequence": lazy("trial of a controller"),
}
TEST_STATES: dict[str, Any] = {
    "requested": lazy("begins"),
    "running": lazy("running"),
    "sealing": lazy("saving"),
    "identifying": lazy("identifying"),
    "completed": lazy("completed"),
    "stopped": lazy("stopped"),
    "fault": lazy("fault"),
    "failed": lazy("no model"),
    "refused": lazy("not started"),
}
DECISIONS: dict[str, Any] = {"approved": lazy("approved"), "rejected": lazy("rejected")}


def segment_words(name: str | None) -> str:
    """What a person calls a segment; a user's own name as it is."""
    return str(SEGMENTS.get(name or "", name or ""))


def verdict_words(verdict: str) -> str:
    """A verdict in the page's language."""
    return str(VERDICTS.get(verdict, verdict))


def test_kind_words(kind: str) -> str:
    """What a person calls a kind of test."""
    return str(TEST_KINDS.get(kind, kind))


def test_state_words(state: str) -> str:
    """How a test stands."""
    return str(TEST_STATES.get(state, state))


def decision_words(decision: str | None) -> str:
    """What was decided on a model."""
    return str(DECISIONS[decision]) if decision in DECISIONS else _("not decided yet")
