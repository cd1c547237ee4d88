"""What pages call things that programs call otherwise: a clinician's word first, the technical term one hover away."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from stimrig.api.language import _, lazy, translated
from stimrig.rig.messages import LABEL_TITLES

WORDS: dict[str, dict[str | None, Any]] = {
    "segment": {
        "rest": lazy("Rest"),
        "prbs": lazy("Random pulses"),
        "ramp": lazy("Ramp"),
        "validate": lazy("Check (not used for fitting)"),
        "opening": lazy("First look"),
        "hold": lazy("Level"),
        "step": lazy("Step"),
        "passive": lazy("No stimulation"),
        "moving": lazy("Level while moving"),
        "widths": lazy("Levels held at random"),
        "levels": lazy("Levels held at random"),
    },
    "verdict": {
        "usable": lazy("usable"),
        "usable with care": lazy("usable with care"),
        "not usable": lazy("not usable"),
        "unknown": lazy("unknown"),
    },
    "kind": {
        "pre-session": lazy("pre-session test"),
        "next-experiment": lazy("next experiment"),
        "sequence": lazy("trial of a controller"),
        "adaptive": lazy("test that stops itself"),
        "passive": lazy("passive movement"),
        "held": lazy("held-angle test"),
        "moving": lazy("movement under stimulation"),
        "muscles": lazy("test of both muscles"),
        "electrode": lazy("stimulus of a search"),
    },
    "title": {
        "pre-session": lazy("Pre-session test"),
        "next-experiment": lazy("Pre-session test"),
        "sequence": lazy("Pre-session test"),
        "adaptive": lazy("Test that stops itself"),
        "passive": lazy("Passive movement"),
        "held": lazy("Held angle"),
        "moving": lazy("Movement under stimulation"),
        "muscles": lazy("Test of both muscles"),
        "electrode": lazy("Stimulus of a search"),
    },
    "end": {
        "known-enough": lazy("Enough is known"),
        "covered": lazy("Enough was seen"),
        "enough": lazy("A person said that it is enough"),
        "torque-time": lazy("The torque-time is used up"),
        "time": lazy("The time is used up"),
        "limit": lazy("A limit of the whole test was reached"),
        "fixed-rest": lazy("The fixed plan was played to its end"),
        "completed": lazy("It was played to its end"),
        "stopped": lazy("Stopped"),
        "fault": lazy("Ended by a fault"),
    },
    "state": {
        "requested": lazy("begins"),
        "running": lazy("running"),
        "sealing": lazy("saving"),
        "identifying": lazy("identifying"),
        "completed": lazy("completed"),
        "stopped": lazy("stopped"),
        "fault": lazy("fault"),
        "failed": lazy("no model"),
        "refused": lazy("not started"),
    },
    "decision": {"approved": lazy("approved"), "rejected": lazy("rejected"), None: lazy("not decided yet")},
}


def words(name: str | None, kind: str) -> str:
    """What people call a thing of a kind (of `WORDS`), in the page's language; a name that is not known as it is."""
    return str(WORDS[kind].get(name, name))


def segment_words(name: str | None) -> str:
    """What a person calls a segment, a number behind it kept; a user's own name as it is."""
    kind, _space, number = (name or "").partition(" ")
    known = WORDS["segment"].get(kind if number.isdecimal() else name or "")
    return (name or "") if known is None else f"{known} {number}".strip()


def label_rows(test: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and text of each label that somebody has said of a test; of its document, its plan, or its request."""
    return [(translated(title), test[name]) for name, title in LABEL_TITLES.items() if test.get(name) is not None]


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
