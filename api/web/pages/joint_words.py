"""What a person is told of a guided test of a joint: before it starts, and how it counts beside the paper's test."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from api.clinical_words import degrees
from api.language import _
from api.sessions import angles
from api.sessions.joint_plan import HELD, PASSIVE
from api.sessions.questions import Row
from api.web.pages.environment import number


def allowed_deg(joint: Mapping[str, Any]) -> tuple[float, float] | None:
    """Between which angles a held test starts, °; None of another one."""
    if joint["target_rad"] is None:
        return None
    middle, half = math.degrees(joint["target_rad"]), math.degrees(joint.get("tolerance_rad", angles.TOLERANCE_RAD))
    return round(middle - half, 2), round(middle + half, 2)


def of_question(
    joint: Mapping[str, Any], profile: Mapping[str, Any], long: str, dose: str
) -> tuple[str, str, list[Row]]:
    """How long, at what dose, and the rows about the angle."""
    range_rad = angles.of(profile)
    more = [Row(_("Joint angles"), _("%(range)s; beyond them the test stops", range=angles.words(range_rad or (0, 0))))]
    if joint["kind"] == HELD:
        more.insert(0, Row(_("Hold at"), degrees(joint["target_rad"])))
        expected = joint["doses"]["held_each"]
    else:
        long = _("at most %(most)s; ends by itself once enough was seen", most=number(joint["longest_s"], 0, "s"))
        expected = joint["doses"]["moving"]
    if joint["kind"] == PASSIVE:
        return long, _("none: no current flows"), more
    if joint["known"]:
        dose = _("about %(effort)s of torque", effort=number(expected, 1, "N·m·s"))
    elif joint["doses"]["paper"] > 0:
        percent = number(100 * expected / joint["doses"]["paper"], 0, "%")
        dose = _("about %(percent)s of the pre-session test's", percent=percent)
    return long, dose, more
