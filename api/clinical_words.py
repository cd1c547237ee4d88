"""What pages call things that programs call otherwise: a clinician's word first, the technical term one hover away."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from stimrig.api.language import _, lazy

SEGMENTS: dict[str, Any] = {
    "rest": lazy("Rest"),
    "prbs": lazy("Random pulses"),
    "ramp": lazy("Ramp"),
    "validate": lazy("Check (not used for fitting)"),
    "opening": lazy("First look"),
    "hold": lazy("Level"),
    "step": lazy("Step"),
    "passive": lazy("No stimulation"),
    "moving": lazy("Level while moving"),
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
    "adaptive": lazy("test that stops itself"),
    "passive": lazy("passive movement"),
    "held": lazy("held-angle test"),
    "moving": lazy("movement under stimulation"),
}
TITLES: dict[str, Any] = {
    "pre-session": lazy("Pre-session test"),
    "adaptive": lazy("Test that stops itself"),
    "passive": lazy("Passive movement"),
    "held": lazy("Held angle"),
    "moving": lazy("Movement under stimulation"),
}
ADAPTIVE_ENDS: dict[str, Any] = {
    "known-enough": lazy("Enough is known"),
    "enough": lazy("A person said that it is enough"),
    "torque-time": lazy("The torque-time is used up"),
    "time": lazy("The time is used up"),
    "limit": lazy("A limit of the whole test was reached"),
    "fixed-rest": lazy("The fixed plan was played to its end"),
    "stopped": lazy("Stopped"),
    "fault": lazy("Ended by a fault"),
}
JOINT_ENDS: dict[str, Any] = {
    "covered": lazy("Enough was seen"),
    "enough": lazy("A person said that it is enough"),
    "torque-time": lazy("The torque-time is used up"),
    "time": lazy("The time is used up"),
    "completed": lazy("It was played to its end"),
    "stopped": lazy("Stopped"),
    "fault": lazy("Ended by a fault"),
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


def _by(words: dict[str, Any]) -> Callable[[str], str]:
    """What people call a thing, in the page's language, by its name; a name that is not known as it is."""
    return lambda name: str(words.get(name, name))


verdict_words = _by(VERDICTS)
"""A verdict in the page's language."""
test_kind_words = _by(TEST_KINDS)
"""What a person calls a kind of test."""
test_state_words = _by(TEST_STATES)
"""How a test stands."""
adaptive_end_words = _by(ADAPTIVE_ENDS)
"""Why a test that stops itself ended."""
joint_end_words = _by(JOINT_ENDS)
"""Why a guided test of a joint ended."""


def segment_words(name: str | None) -> str:
    """What a person calls a segment, a number behind it kept; a user's own name as it is."""
    kind, _space, number = (name or "").partition(" ")
    known = SEGMENTS.get(kind if number.isdecimal() else name or "")
    return (name or "") if known is None else f"{known} {number}".strip()


def test_title(kind: str) -> str:
    """The title of a test's page."""
    return str(TITLES.get(kind, TITLES["pre-session"]))


def missing_words(missing: Sequence[Mapping[str, Any]] | None) -> list[str]:
    """What is still to be done with the joint, a sentence for each stretch of angles."""
    return [_stretch(each) for each in missing or ()]


def _stretch(each: Mapping[str, Any]) -> str:
    low, high = (degrees(each[name]) for name in ("from_rad", "to_rad"))
    bends, slow = each["direction"] == "flexion", each["speed"] == "slow"
    if bends and slow:
        return _("Bend slowly from %(low)s to %(high)s.", low=low, high=high)
    if bends:
        return _("Bend faster from %(low)s to %(high)s.", low=low, high=high)
    if slow:
        return _("Straighten slowly from %(high)s to %(low)s.", low=low, high=high)
    return _("Straighten faster from %(high)s to %(low)s.", low=low, high=high)


def degrees(angle_rad: float | None) -> str:
    """An angle for people: whole degrees; a dash where there is none."""
    return "–" if angle_rad is None else f"{math.degrees(angle_rad):.0f}°".replace("-", "−")


def decision_words(decision: str | None) -> str:
    """What was decided on a model."""
    return str(DECISIONS[decision]) if decision in DECISIONS else _("not decided yet")
