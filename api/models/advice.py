"""Advice to the person who decides on a model: what to do next, which checks failed, what a controller would risk.

`identify` judges (the gates in MODEL.json). Here each failed gate gets a clinician's words; the sentence of `identify`
stays beside them as the technical term.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from stimrig.api.models.stored_model import followed

Act = Literal["approve", "add", "improve", "experiment", "look", "test", "fit", "wait"]
"""The button of the page. "improve" adds several effects one by one; with "wait" there is none."""


class Gate(NamedTuple):
    """Texts of a failed check."""

    problem: str
    risk: str  # what the controller would do wrong
    inspect: str = "look at where the error sits first"  # with a model that is usable with care
    test: str = "the limb held still and relaxed"  # test again with, for a model that is not usable


class Finding(NamedTuple):
    """A failed check in a clinician's words and in those of `identify`."""

    gate: str
    words: str
    risk: str
    technical: str
    severe: bool


class Advice(NamedTuple):
    """The sentence at the top of a model's page, and its button."""

    act: Act
    words: str


_CURVE = "look at the recruitment curve first"
_WIRES = "electrodes, current and load cell checked"
GATES: dict[str, Gate] = {
    "stable": Gate(
        "The dynamics are unstable: in the model the torque grows without end.",
        "The controller would expect torque that grows without end, and may switch between no and full pulses.",
        "look at the step response first",
    ),
    "converged": Gate(
        "The search for the muscle's speed did not come to its end.",
        "The speed of the muscle is not certain: the controller may react too early or too late.",
        "look at the step response first",
    ),
    "torque": Gate(
        "The pulses hardly change the torque, or the recruitment curve is far outside what was measured.",
        "The controller would set too wide pulses: the recruitment curve is not identified.",
        _CURVE,
        _WIRES,
    ),
    "monotone": Gate(
        "The recruitment curve falls at one place.",
        "The controller's pulse width jumps where the curve falls: two widths belong to one torque there.",
        _CURVE,
        _WIRES,
    ),
    "range": Gate(
        "Only a few pulse widths were measured; between them the recruitment curve is a guess.",
        "The controller would set pulse widths that were never measured: the plateau is not identified.",
        f"{_CURVE}; a test with a ramp makes it sure",
        "a ramp",
    ),
    "ceiling": Gate(
        "The fit is less than the noise would allow.",
        "The model does not follow the torque: the controller's pulses would be too wide at one time and too narrow at "
        "another.",
        test="electrodes checked and the limb relaxed",
    ),
    "held_out": Gate(
        "The error on held-out pulses is clearly larger than on the others.",
        "On other pulses the controller would be further off than the fit says.",
        "look at the check in the chart first",
    ),
    "gap": Gate(
        "The fit on held-out pulses is less than the noise would allow.",
        "The controller works with pulses that the model has not seen: its torque there would be far off.",
        test="the limb held still and relaxed, or add what is missing",
    ),
    "residual": Gate(
        "What the model leaves over is not only noise.",
        "The error follows a pattern, and the controller repeats it in each trial.",
    ),
    "joint": Gate(
        "The joint moved during the test, and the model does not know of it.",
        "At another angle the muscle is stronger or weaker: the controller's pulses would not fit.",
        "hold the joint still and test again, or add what depends on the joint",
    ),
    "joint_seen": Gate(
        "The joint hardly moved in these tests: how the torque depends on it is a guess.",
        "At another angle the torque that the controller expects is a guess.",
        "at the angle of these tests only",
        "the joint moving",
    ),
    "evidence": Gate(
        "It holds an effect that was added without evidence.",
        "The controller would rely on an effect of which the recording gives no evidence.",
        "the recording does not ask for an effect in it. Compare it with the version before",
    ),
    "sensor": Gate(
        "The load cell shows the same torque again and again: it clips, or it is not connected.",
        "The controller would set too wide pulses: the plateau is not identified, as the load cell could not show it.",
        "look at the highest torques in the chart first; the load cell clips",
        "the load cell checked",
    ),
}
"""Each check of `stimrig.identify.estimation.quality`, and `stored_model.without_evidence`, which never refuses."""

STILL_USABLE = {
    "unsure": " Whether something is missing, this recording cannot tell.",
    "unexplained": " Some error is left that is not explained.",
    "missing": " An effect is possibly missing.",
}
"""Remark on a usable model by the kind of its diagnosis, where that names no likely effect."""


def findings(document: dict[str, Any]) -> list[Finding]:
    """List the failed checks, those that make a model not usable first; empty for models without stored checks."""
    gates = (document.get("quality") or {}).get("gates", {})
    failed = [
        Finding(name, GATES[name].problem, GATES[name].risk, gate["says"], gate["severity"] == "refuse")
        for name, gate in gates.items() if not gate["passed"]
    ]  # fmt: skip
    return sorted(failed, key=lambda finding: (not finding.severe, finding.gate != "evidence"))


def advice(
    verdict: str, failed: Sequence[Finding], missing: Sequence[str], kind: str | None = "nothing", *,
    diagnosing: bool = False, experiment: bool = False,
) -> Advice:  # fmt: skip
    """Say what to do with a model, from its verdict and its diagnosis.

    Parameters
    ----------
    verdict : str
        The verdict of `identify`.
    failed : sequence of Finding
        The failed checks, the worst first.
    missing : sequence of str
        Names of the effects that the diagnosis found likely to be missing.
    kind : str, optional
        Kind of the diagnosis' conclusion; None without a diagnosis.
    diagnosing : bool
        The diagnosis is under way.
    experiment : bool
        The diagnosis has planned a further test.
    """
    effects = " and ".join(f"“{name}”" for name in missing)
    add: Act = "add" if len(missing) == 1 else "improve"
    worst = GATES[failed[0].gate] if failed else None
    if verdict == "not usable":
        if missing and all(finding.gate in ("gap", "ceiling") for finding in failed if finding.severe):
            return Advice(add, f"Not usable as it is: add {effects}, or test again.")
        condition = worst.test if worst else "electrodes, fixture and load cell checked"
        return Advice("test", f"Not usable: test again with {condition}.")
    if verdict not in ("usable", "usable with care"):
        return Advice("fit", "There is no verdict on this model: test again, or fit the recording again.")
    if diagnosing:
        return Advice("wait", "Wait: what is missing in the model is still being looked for.")
    if verdict == "usable":
        if missing:
            return Advice(add, f"Usable, and better with {effects}: add that first.")
        return Advice("approve", f"Usable: approve it.{STILL_USABLE.get(kind or '', '')}")
    if missing:
        return Advice(add, f"Usable with care: add {effects} first.")
    words = f"Usable with care: {worst.inspect if worst else 'look at where the error sits first'}."
    if kind in ("nothing", "unsure") and not (failed and failed[0].gate == "evidence"):
        return Advice("approve", words)
    if experiment:
        return Advice("experiment", "Usable with care: play the next experiment first.")
    return Advice("look", words)


def risks(document: dict[str, Any], failed: Sequence[Finding]) -> list[str]:
    """List what a controller would risk with a model that is not usable, in sentences."""
    fit_percent = (document.get("fit") or {}).get("held_out_fit_percent")
    sentences = list(dict.fromkeys(finding.risk for finding in failed))
    if fit_percent is not None:
        sentences.append(f"On held-out pulses the error is {100.0 - fit_percent:.0f} % of the torque.")
    return sentences or ["Nobody knows how far the torque will be from what the controller expects."]


def fit_sentence(fit: dict[str, Any]) -> str:
    """Say how much of the torque the model follows and how much the noise allows, on held-out pulses if there are any.

    Empty where the fit is not defined.
    """
    figure = followed(fit)
    if figure.percent is None:
        return ""
    if figure.percent <= 0.0:
        return f"{figure.where} the model does not follow the torque at all."
    ceiling = figure.ceiling_percent
    allowed = "" if ceiling is None else f"; the noise allows about {ceiling:.1f} %"
    return f"{figure.where} the fit is {figure.percent:.1f} %{allowed}."
