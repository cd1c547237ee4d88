"""Clinicians' words for what programs name otherwise; pages show the technical term as the title."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from stimrig.rig.messages import LABEL_TITLES

WORDS: dict[str, dict[str, str]] = {
    "segment": {
        "rest": "Rest",
        "prbs": "Random pulses",
        "ramp": "Ramp",
        "validate": "Check (not used for fitting)",
        "opening": "First look",
        "hold": "Level",
        "step": "Step",
        "passive": "No stimulation",
        "moving": "Level while moving",
        "widths": "Random levels",
        "levels": "Random levels",
    },
    "kind": {
        "pre-session": "pre-session test",
        "next-experiment": "next experiment",
        "sequence": "trial of a controller",
        "adaptive": "test that stops itself",
        "passive": "passive movement",
        "held": "held-angle test",
        "moving": "movement under stimulation",
    },
    "end": {
        "known-enough": "Enough is known",
        "covered": "Enough was seen",
        "enough": "A person said that it is enough",
        "torque-time": "The torque-time is used up",
        "time": "The time is used up",
        "limit": "A limit of the whole test was reached",
        "fixed-rest": "The fixed plan was played to its end",
        "completed": "It was played to its end",
        "stopped": "Stopped",
        "fault": "Ended by a fault",
    },
    "state": {
        "requested": "begins",
        "running": "running",
        "sealing": "saving",
        "identifying": "identifying",
        "completed": "completed",
        "stopped": "stopped",
        "fault": "fault",
        "failed": "no model",
        "refused": "not started",
    },
}


def words(name: str, kind: str) -> str:
    """Return the word for a name of a kind of `WORDS`; an unknown name as it is."""
    return WORDS[kind].get(name, name)


def segment_words(name: str | None) -> str:
    """Return the word for a segment and its number; a user's own name as it is."""
    kind, _space, number = (name or "").partition(" ")
    known = WORDS["segment"].get(kind if number.isdecimal() else name or "")
    return (name or "") if known is None else f"{known} {number}".strip()


def label_rows(test: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return title and text of each label of a test: of its document, its plan, or its request."""
    return [(title, test[name]) for name, title in LABEL_TITLES.items() if test.get(name) is not None]


def missing_words(missing: Sequence[Mapping[str, Any]] | None) -> list[str]:
    """Say what is still to be done with the joint, a sentence for each range of angles."""
    sentences = []
    for each in missing or ():
        low, high = (degrees(each[name]) for name in ("from_rad", "to_rad"))
        how = "slowly" if each["speed"] == "slow" else "faster"
        bends = each["direction"] == "flexion"
        sentences.append(f"Bend {how} from {low} to {high}." if bends else f"Straighten {how} from {high} to {low}.")
    return sentences


def degrees(angle_rad: float | None) -> str:
    """Write an angle in whole degrees; a dash for None."""
    return "–" if angle_rad is None else f"{math.degrees(angle_rad):.0f}°".replace("-", "−")
