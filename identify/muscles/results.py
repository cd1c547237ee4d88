"""What a diagnosis and an improvement of several muscles say, with the keys of those of one muscle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from stimrig.identify.conclusion import LIKELY, SURE
from stimrig.identify.effects import find_effect
from stimrig.identify.muscles.interplay import registry
from stimrig.identify.muscles.model import JointModel
from stimrig.identify.results import Result, Row
from stimrig.identify.summary import Sheet, quantity


def name_of(key: str) -> str:
    """For people: "Cross-talk from biceps to triceps", "Fatigue of biceps", "Baseline drift"."""
    identifier, _, ends = key.partition(":")
    if identifier in registry():
        giving, _, taking = ends.partition(">")
        return registry()[identifier].name + (f" from {giving} to {taking}" if ends else "")
    whose, _, effect = key.partition(".")
    name = find_effect(effect).name
    return name if whose == "joint" else f"{name} of {whose}"


@dataclass(frozen=True, repr=False, eq=False)
class JointDiagnosis(Result):
    """What the model of several muscles lacks."""

    noise_sd_nm: float  # white noise of a sample
    base: Row  # errors of the examined model, as `JointModel.fit`
    verdict: str  # "effect_missing", "nothing_missing" or "unexplained_structure"
    missing: tuple[Row, ...]
    """Most probable first: `effect` (a key such as "cross_talk:biceps>triceps" or "biceps.fatigue"), `name`, `form`,
    `probability`, errors before and after, `confused_with`, `next_experiment` and `plain`."""
    muscles: tuple[Row, ...]  # for each channel `name`, and whether its own record keeps `unexplained` structure
    candidates: tuple[Row, ...]  # what was tried and not added: `effect`, `log_evidence_gain`, `reason`
    model: JointModel  # the examined one
    conclusion: Mapping[str, str]  # `kind`, `title`, `words` and `advice`
    notes: tuple[str, ...]  # what was assumed of the record

    def to_dict(self) -> dict[str, Any]:
        """As JSON, without the model.

        Returns
        -------
        dict
        """
        return {key: value for key, value in super().to_dict().items() if key != "model"}

    def _sheet(self) -> Sheet:
        rows = [("what it comes to", self.conclusion["words"]), ("what to do", self.conclusion["advice"])]
        for row in self.missing:
            errors = f"{quantity(row['rms_before_nm'], 'N·m')} to {quantity(row['rms_after_nm'], 'N·m')}"
            rows.append((row["name"], f"{100 * row['probability']:.0f} %, error {errors}"))
        rows += [("note", note) for note in self.notes]
        return Sheet(f"Diagnosis: {self.conclusion['title']}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class JointImprovement(Result):
    """The models of several muscles, each with one thing more."""

    noise_sd_nm: float  # white noise of a sample
    verdict: str  # of the last model
    steps: tuple[Row, ...]  # `added`, `name`, `model_id`, `reason`, and the errors
    models: tuple[JointModel, ...]  # one thing more each
    refused: tuple[Row, ...]  # `effect`, `log_evidence_gain`, `reason`

    def _sheet(self) -> Sheet:
        rows = []
        for step in self.steps:
            unseen = quantity(step["held_out_rms_nm"], "N·m")
            rows.append((step["name"], f"error {quantity(step['rms_nm'], 'N·m')}, held out {unseen}"))
        return Sheet(f"Improvement in {len(self.steps) - 1} steps", tuple(rows))


def conclude(missing: tuple[Row, ...], unexplained: list[str]) -> dict[str, str]:
    """The verdict for people, with what to do next."""
    if missing:
        sure = missing[0]["probability"]
        how = "very probably " if sure > SURE else "probably " if sure > LIKELY else "possibly "
        names = ", ".join(row["name"] for row in missing)
        words = f"The record gives evidence for: {names}."
        if unexplained:
            words += f" In {' and '.join(unexplained)} some structure is left that nothing explains."
        title = f"Something is {how}missing in the model"
        return {"kind": "missing", "title": title, "words": words, "advice": f"Add {missing[0]['name']}."}
    if unexplained:
        words = f"The error in {' and '.join(unexplained)} has structure that no effect of the library explains."
        return {"kind": "unexplained", "title": "Structure is left", "words": words, "advice": "Use it with care."}
    words = "Neither an interplay nor an effect explains more than noise would."
    return {
        "kind": "nothing",
        "title": "Nothing is missing: what is left is noise",
        "words": words,
        "advice": "Use this model.",
    }
