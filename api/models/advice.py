"""What a model's verdict means for the person who decides: what to do, what was found, what a controller would risk.

`identify` judges (the gates in MODEL.json); here each gate that failed is said in a clinician's words, and identify's
own sentence stays beside it as the technical term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from stimrig.api.models.stored_model import followed

Act = Literal["approve", "look", "add", "improve", "test", "fit", "wait"]
"""The first button; with "look", "fit" and "wait" there is none. "improve" adds several effects one by one."""


class Gate(NamedTuple):
    """Texts of a check that failed: what was found, what to do with a model that is usable with care and with one that
    is not usable, and what the controller would do wrong."""

    found: str
    look: str
    test: str
    risk: str


@dataclass(frozen=True)
class Finding:
    """A check that failed, in a clinician's words, and in identify's."""

    gate: str
    words: str
    risk: str
    technical: str
    severe: bool


@dataclass(frozen=True)
class Advice:
    """The sentence at the top of a model's page, and its first button."""

    act: Act
    words: str


GATES: dict[str, Gate] = {
    "stable": Gate(
        "The dynamics are unstable: in the model the torque grows without end.",
        "Usable with care: look at the step response first.",
        "Not usable: test again with the limb held still and relaxed.",
        "The controller would expect torque that grows without end, and may switch between no and full pulses.",
    ),
    "converged": Gate(
        "The search for the muscle's speed did not come to its end.",
        "Usable with care: look at the step response first.",
        "Not usable: test again with the limb held still and relaxed.",
        "The speed of the muscle is not certain: the controller may react too early or too late.",
    ),
    "torque": Gate(
        "The pulses hardly change the torque, or the recruitment curve is far outside what was measured.",
        "Usable with care: look at the recruitment curve first.",
        "Not usable: test again with electrodes, current and load cell checked.",
        "The controller would set too wide pulses: the recruitment curve is not identified.",
    ),
    "monotone": Gate(
        "The recruitment curve falls at one place.",
        "Usable with care: look at the recruitment curve first.",
        "Not usable: test again with electrodes, current and load cell checked.",
        "The controller's pulse width jumps where the curve falls: two widths belong to one torque there.",
    ),
    "range": Gate(
        "Only a few pulse widths were measured; between them the recruitment curve is a guess.",
        "Usable with care: look at the recruitment curve first; a test with a ramp makes it sure.",
        "Not usable: test again with a ramp.",
        "The controller would set pulse widths that were never measured: the plateau is not identified.",
    ),
    "ceiling": Gate(
        "The fit is less than the noise would allow.",
        "Usable with care: look at where the error sits first.",
        "Not usable: test again with electrodes checked and the limb relaxed: the torque hardly follows.",
        ("The model does not follow the torque: the controller's pulses would be too wide at one time and too "
             "narrow at another."),
    ),
    "held_out": Gate(
        "The error on held-out pulses is clearly larger than on the others.",
        "Usable with care: look at the check in the chart first.",
        "Not usable: test again with the limb held still and relaxed.",
        "On other pulses the controller would be further off than the fit says.",
    ),
    "gap": Gate(
        "The fit on held-out pulses is less than the noise would allow.",
        "Usable with care: look at where the error sits first.",
        "Not usable: test again with the limb held still and relaxed, or add what is missing.",
        "The controller works with pulses that the model has not seen: its torque there would be far off.",
    ),
    "residual": Gate(
        "What the model leaves over is not only noise.",
        "Usable with care: look at where the error sits first.",
        "Not usable: test again with the limb held still and relaxed.",
        "The error follows a pattern, and the controller repeats it in each trial.",
    ),
    "joint": Gate(
        "The joint moved during the test, and the model does not know of it.",
        "Usable with care: hold the joint still and test again, or add what depends on the joint.",
        "Not usable: test again with the limb held still and relaxed.",
        "At another angle the muscle is stronger or weaker: the controller's pulses would not fit.",
    ),
    "joint_seen": Gate(
        "The joint hardly moved in these tests: how the torque depends on it is a guess.",
        "Usable with care: at the angle of these tests only.",
        "Not usable: record again while the joint moves.",
        "At another angle the torque that the controller expects is a guess.",
    ),
    "evidence": Gate(
        "It holds an effect that was added without evidence.",
        "Usable with care: the recording does not ask for an effect in it. Compare it with the version before.",
        "Not usable: go back to the version before.",
        "The controller would rely on an effect of which the recording gives no evidence.",
    ),
    "sensor": Gate(
        "The load cell shows the same torque again and again: it clips, or it is not connected.",
        "Usable with care: look at the highest torques in the chart first; the load cell clips.",
        "Not usable: test again with the load cell checked.",
        ("The controller would set too wide pulses: the plateau is not identified, as the load cell could not "
             "show it."),
    ),
}  # fmt: skip
"""Each check of `stimrig.identify.estimation.quality`, and `stored_model.without_evidence`."""


BESIDE: dict[str, str] = {
    "unsure": "Usable: approve it. Whether something is missing, this recording cannot tell.",
    "unexplained": "Usable: approve it. Some error is left that is not explained.",
    "missing": "Usable: approve it. An effect is possibly missing.",
}
"""What to do with a usable model whose diagnosis is not that nothing is missing, and names no likely effect."""


def findings(document: dict[str, Any]) -> list[Finding]:
    """The checks that failed, those that make a model not usable first; empty for models without stored checks."""
    gates = (document.get("quality") or {}).get("gates") or {}
    failed = [(name, gate) for name, gate in gates.items() if not gate.get("passed", True)]
    failed.sort(key=lambda pair: (pair[1].get("severity") != "refuse", pair[0] != "evidence"))
    return [
        Finding(name, str(known.found), str(known.risk), gate.get("says", ""), gate.get("severity") == "refuse")
        for name, gate in failed
        if (known := GATES.get(name)) is not None
    ]


def advice(
    verdict: str, found: Sequence[Finding], missing: Sequence[str], kind: str | None = "nothing", looking: bool = False
) -> Advice:
    """What to do with a model: one sentence for its verdict and for what its diagnosis found.

    `verdict`: identify's; `found`: the checks that failed, the worst first; `missing`: names of effects that the
    diagnosis found likely to be missing.
    """
    effects = " and ".join(f"“{name}”" for name in missing)
    add: Act = "add" if len(missing) == 1 else "improve"
    first = GATES[found[0].gate] if found else None
    if looking and verdict in ("usable", "usable with care"):
        return Advice("wait", "Wait: what is missing in the model is still being looked for.")
    if verdict == "usable":
        if missing:
            return Advice(add, f"Usable, and better with {effects}: add that first.")
        return Advice("approve", BESIDE.get(kind or "", "Usable: approve it."))
    if verdict == "usable with care":
        if missing:
            return Advice(add, f"Usable with care: add {effects} first.")
        look = first.look if first else "Usable with care: look at where the error sits first."
        forced = bool(found) and found[0].gate == "evidence"
        return Advice("approve" if kind in ("nothing", "unsure") and not forced else "look", look)
    if verdict == "not usable":
        if missing and all(finding.gate in ("gap", "ceiling") for finding in found if finding.severe):
            return Advice(add, f"Not usable as it is: add {effects}, or test again.")
        again = "Not usable: test again with electrodes, fixture and load cell checked."
        return Advice("test", str(first.test) if first else again)
    return Advice("fit", "There is no verdict on this model: test again, or fit the recording again.")


def risks(document: dict[str, Any], found: Sequence[Finding]) -> list[str]:
    """What a controller would risk with a model that is not usable, in sentences."""
    fit = (document.get("fit") or {}).get("held_out_fit_percent")
    said = list(dict.fromkeys(finding.risk for finding in found))
    if fit is not None:
        error = f"{100.0 - fit:.0f}"
        said.append(f"On held-out pulses the error is {error} % of the torque.")
    return said or ["Nobody knows how far the torque will be from what the controller expects."]


def fit_sentence(fit: dict[str, Any]) -> str:
    """How much of the torque the model follows, and how much noise lets it: of pulses not used for fitting if any."""
    found = followed(fit)
    if found.percent is None:
        return ""
    if found.percent <= 0.0:
        return f"{found.where} the model does not follow the torque at all."
    reached = f"{found.percent:.1f}"
    fit_is = f"{found.where} the fit is {reached} %"
    if found.ceiling_percent is None:
        return f"{fit_is}."
    limit = f"the noise allows about {found.ceiling_percent:.1f} %"
    return f"{fit_is}; {limit}."
