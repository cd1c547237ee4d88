"""What a model's verdict means for the person who decides: what to do, what was found, what a controller would risk.

`identify` judges (the gates in MODEL.json); here each gate that failed is said in a clinician's words, and identify's
own sentence stays beside it as the technical term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from stimrig.api.language import _, lazy, localised, plain
from stimrig.api.models.stored_model import followed

Act = Literal["approve", "look", "add", "improve", "test", "fit", "wait"]
"""The first button; with "look", "fit" and "wait" there is none. "improve" adds several effects one by one."""


class Gate(NamedTuple):
    """Texts of a check that failed: what was found, what to do with a model that is usable with care and with one that
    is not usable, and what the controller would do wrong."""

    found: Any
    look: Any
    test: Any
    risk: Any


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
        lazy("The dynamics are unstable: in the model the torque grows without end."),
        lazy("Usable with care: look at the step response first."),
        lazy("Not usable: test again with the limb held still and relaxed."),
        lazy("The controller would expect torque that grows without end, and may switch between no and full pulses."),
    ),
    "converged": Gate(
        lazy("The search for the muscle's speed did not come to its end."),
        lazy("Usable with care: look at the step response first."),
        lazy("Not usable: test again with the limb held still and relaxed."),
        lazy("The speed of the muscle is not certain: the controller may react too early or too late."),
    ),
    "torque": Gate(
        lazy("The pulses hardly change the torque, or the recruitment curve is far outside what was measured."),
        lazy("Usable with care: look at the recruitment curve first."),
        lazy("Not usable: test again with electrodes, current and load cell checked."),
        lazy("The controller would set too wide pulses: the recruitment curve is not identified."),
    ),
    "monotone": Gate(
        lazy("The recruitment curve falls at one place."),
        lazy("Usable with care: look at the recruitment curve first."),
        lazy("Not usable: test again with electrodes, current and load cell checked."),
        lazy("The controller's pulse width jumps where the curve falls: two widths belong to one torque there."),
    ),
    "range": Gate(
        lazy("Only a few pulse widths were measured; between them the recruitment curve is a guess."),
        lazy("Usable with care: look at the recruitment curve first; a test with a ramp makes it sure."),
        lazy("Not usable: test again with a ramp."),
        lazy("The controller would set pulse widths that were never measured: the plateau is not identified."),
    ),
    "ceiling": Gate(
        lazy("The fit is less than the noise would allow."),
        lazy("Usable with care: look at where the error sits first."),
        lazy("Not usable: test again with electrodes checked and the limb relaxed: the torque hardly follows."),
        lazy("The model does not follow the torque: the controller's pulses would be too wide at one time and too "
             "narrow at another."),
    ),
    "held_out": Gate(
        lazy("The error on held-out pulses is clearly larger than on the others."),
        lazy("Usable with care: look at the check in the chart first."),
        lazy("Not usable: test again with the limb held still and relaxed."),
        lazy("On other pulses the controller would be further off than the fit says."),
    ),
    "gap": Gate(
        lazy("The fit on held-out pulses is less than the noise would allow."),
        lazy("Usable with care: look at where the error sits first."),
        lazy("Not usable: test again with the limb held still and relaxed, or add what is missing."),
        lazy("The controller works with pulses that the model has not seen: its torque there would be far off."),
    ),
    "residual": Gate(
        lazy("What the model leaves over is not only noise."),
        lazy("Usable with care: look at where the error sits first."),
        lazy("Not usable: test again with the limb held still and relaxed."),
        lazy("The error follows a pattern, and the controller repeats it in each trial."),
    ),
    "joint": Gate(
        lazy("The joint moved during the test, and the model does not know of it."),
        lazy("Usable with care: hold the joint still and test again, or add what depends on the joint."),
        lazy("Not usable: test again with the limb held still and relaxed."),
        lazy("At another angle the muscle is stronger or weaker: the controller's pulses would not fit."),
    ),
    "joint_seen": Gate(
        lazy("The joint hardly moved in these tests: how the torque depends on it is a guess."),
        lazy("Usable with care: at the angle of these tests only."),
        lazy("Not usable: record again while the joint moves."),
        lazy("At another angle the torque that the controller expects is a guess."),
    ),
    "evidence": Gate(
        lazy("It holds an effect that was added without evidence."),
        lazy("Usable with care: the recording does not ask for an effect in it. Compare it with the version before."),
        lazy("Not usable: go back to the version before."),
        lazy("The controller would rely on an effect of which the recording gives no evidence."),
    ),
    "sensor": Gate(
        lazy("The load cell shows the same torque again and again: it clips, or it is not connected."),
        lazy("Usable with care: look at the highest torques in the chart first; the load cell clips."),
        lazy("Not usable: test again with the load cell checked."),
        lazy("The controller would set too wide pulses: the plateau is not identified, as the load cell could not "
             "show it."),
    ),
}  # fmt: skip
"""Each check of `stimrig.identify.estimation.quality`, and `stored_model.without_evidence`."""


BESIDE: dict[str, Any] = {
    "unsure": lazy("Usable: approve it. Whether something is missing, this recording cannot tell."),
    "unexplained": lazy("Usable: approve it. Some error is left that is not explained."),
    "missing": lazy("Usable: approve it. An effect is possibly missing."),
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
    effects = _(" and ").join(_("“%(name)s”", name=plain(name)) for name in missing)
    add: Act = "add" if len(missing) == 1 else "improve"
    first = GATES[found[0].gate] if found else None
    if looking and verdict in ("usable", "usable with care"):
        return Advice("wait", _("Wait: what is missing in the model is still being looked for."))
    if verdict == "usable":
        if missing:
            return Advice(add, _("Usable, and better with %(effects)s: add that first.", effects=effects))
        return Advice("approve", str(BESIDE.get(kind or "", _("Usable: approve it."))))
    if verdict == "usable with care":
        if missing:
            return Advice(add, _("Usable with care: add %(effects)s first.", effects=effects))
        look = str(first.look) if first else _("Usable with care: look at where the error sits first.")
        forced = bool(found) and found[0].gate == "evidence"
        return Advice("approve" if kind in ("nothing", "unsure") and not forced else "look", look)
    if verdict == "not usable":
        if missing and all(finding.gate in ("gap", "ceiling") for finding in found if finding.severe):
            return Advice(add, _("Not usable as it is: add %(effects)s, or test again.", effects=effects))
        again = _("Not usable: test again with electrodes, fixture and load cell checked.")
        return Advice("test", str(first.test) if first else again)
    return Advice("fit", _("There is no verdict on this model: test again, or fit the recording again."))


def risks(document: dict[str, Any], found: Sequence[Finding]) -> list[str]:
    """What a controller would risk with a model that is not usable, in sentences."""
    fit = (document.get("fit") or {}).get("held_out_fit_percent")
    said = list(dict.fromkeys(finding.risk for finding in found))
    if fit is not None:
        error = f"{100.0 - fit:.0f}"
        said.append(_("On held-out pulses the error is %(percent)s %% of the torque.", percent=error))
    return said or [_("Nobody knows how far the torque will be from what the controller expects.")]


def fit_sentence(fit: dict[str, Any]) -> str:
    """How much of the torque the model follows, and how much noise lets it: of pulses not used for fitting if any."""
    found = followed(fit)
    if found.percent is None:
        return ""
    if found.percent <= 0.0:
        return _("%(where)s the model does not follow the torque at all.", where=found.where)
    reached = localised(f"{found.percent:.1f}")
    fit_is = _("%(where)s the fit is %(reached)s %%", where=found.where, reached=reached)
    if found.ceiling_percent is None:
        return f"{fit_is}."
    limit = _("the noise allows about %(ceiling)s %%", ceiling=localised(f"{found.ceiling_percent:.1f}"))
    return f"{fit_is}; {limit}."
