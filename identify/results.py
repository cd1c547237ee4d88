"""The results of `compare`, `diagnose`, `improve`, `carry`. Fields are the keys of `--json`; api/schemas defines them.

Rows of tables are dicts with the keys of the schema. `to_dict()` gives JSON values. `print` shows about ten lines,
`repr` one line, and a notebook a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from stimrig.identify.conclusion import Conclusion, conclude, why_ended
from stimrig.identify.healing import healed_places, looks_like_noise, place_words, stands_out
from stimrig.identify.json_text import json_value
from stimrig.identify.model import Model
from stimrig.identify.summary import (
    Sheet,
    Summarised,
    both_words,
    certainty,
    change_words,
    fit_words,
    parameter_words,
    quantity,
    torque,
)
from stimrig.identify.yardstick import contradiction_words, repetition_words, zero_words

Row = Mapping[str, Any]
CORRELATED_WITH = {"residual": "itself", "u": "the pulse width", "u2": "the pulse width's square", "y": "the torque"}
MOST_PARAMETERS = 3
"""Parameters of an effect that a summary shows."""
FEW = 3
"""Number of rows of a long table that a summary shows."""


class Result(Summarised):
    """A dataclass that is shown, and written as JSON."""

    def to_dict(self) -> dict[str, Any]:
        """All fields as dicts, lists, numbers and texts; None for a number that is not finite."""
        return {
            name: [model.to_dict() for model in value] if name == "models" else json_value(value)
            for name, value in vars(self).items()
        }


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(Result):
    """A model compared with a measurement. Per cent are NaN where the torque is constant."""

    fit_percent: float  # best fit on all rows
    ceiling_percent: float  # the best fit that the noise allows
    rms_nm: float  # error on all rows
    excess_rms_nm: float  # the part of it above the noise
    samples: int  # number of rows
    noise_sd_nm: float  # white measurement noise of a sample
    repetition: Row  # what repeats, and how much of it the model explains: see `identify.estimation.repetition`
    contradiction: Row | None
    """Whether fits to parts of the record contradict each other: see `identify.estimation.contradiction`; None for
    another record than the model's own, or where the parts have too little."""
    fitted: Row  # the first five fields for rows that may be fitted
    held_out: Row | None  # the same for rows of `validate`; None if there are none
    by: Mapping[str, Sequence[Row]]
    """The error by "segment", "level" of pulse width, "direction", "time" and "frequency"; each row has `label`,
    `rms_nm` and `share_of_excess`."""
    tests: Row
    """Correlations of the residual: `lags_s`, `false_alarm_rate`, `innovations`, and `tests`, each with `with`,
    `values`, `band`, `largest`, `at_lag_s`, `passed`, `words`."""
    where: tuple[Row, ...]
    """Worst places first: `segment`, `start_s`, `end_s`, `pulse_width_us`, `direction`, `share_of_excess`,
    `mean_error_nm`, `text`."""
    series: Row
    """Values for plots, at most 2400 points: `time_s`, `torque_nm`, `predicted_torque_nm`, `lower_nm`, `upper_nm`,
    `residual_nm`, `pulse_width_us`, `segment`, `noise_band_nm`."""
    wandering_zero_nm: float
    """Root mean square of the residual's means in the rests; 0 where it is a small part of the error, the residual
    looks like noise, or there are too few rests."""
    left_out: str  # how much was not counted, and why; empty if everything was counted
    plain: tuple[str, ...]  # sentences for people

    def _sheet(self) -> Sheet:
        failed = [str(test["with"]) for test in self.tests["tests"] if not test["passed"]]
        alarms = [CORRELATED_WITH.get(name, name) for name in failed]
        rows = [
            ("all rows", _figures(vars(self))),
            ("fitted pulses", _figures(self.fitted)),
            ("held out", "no part `validate`" if self.held_out is None else _figures(self.held_out)),
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')}, sd of a sample"),
            ("repetition", repetition_words(vars(self))),
            ("residual", f"not noise: correlated with {', '.join(alarms)}" if alarms else "looks like noise"),
        ]
        rows += [("parts", words)] if (words := contradiction_words(self.contradiction)) else []
        rows += [("note", zero_words(self.wandering_zero_nm))] * bool(self.wandering_zero_nm)
        if not looks_like_noise(vars(self)):
            rows += _listed("worst place", [row["text"] for row in self.where[:FEW]])
            rows += [(f"by {kind}", _shares(self.by[kind])) for kind in ("segment", "direction") if self.by.get(kind)]
        fit, ceiling = quantity(self.fit_percent, "%"), quantity(self.ceiling_percent, "%")
        return Sheet(f"Comparison: fit {fit} where the noise allows {ceiling}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(Result):
    """Diagnosis of the effects that the model of a record lacks."""

    noise_sd_nm: float  # white measurement noise of a sample
    slow_noise: Row  # `sd_nm`, and `ar1`, the correlation of neighbouring pulse intervals
    base: Row
    """The model of the examined structure: `fit_percent`, `rms_nm`, `ceiling_percent`, the same with `held_out_`, and
    `held_out_by`, the source of the held-out values."""
    verdict: str  # "effect_missing", "nothing_missing" or "unexplained_structure"
    probability: float  # of the verdict, 0 to 1
    table: tuple[Row, ...]
    """What was tried: no change, then each effect: `effect`, `name`, `parameters`, `change_percent` of the error on
    left-out parts, its `sd_percent`, `probability`, the `seconds` that drive it, `status` ("add", "cannot decide",
    "refused") and its `reason`."""
    missing: tuple[Row, ...]
    """Effects, most probable first: `effect`, `name`, `probability`, errors before and after, `confused_with`,
    `next_experiment` (words) and `next_experiment_plan`, `form`, `equation`, `parameters`, `rival_probabilities`,
    `plain`."""
    free: tuple[Row, ...]
    """Free effects, which describe what no effect of the library explains: `effect`, `name`, `form`, `equation`,
    `parameters`, `place`, `driven_by`, `words`, `behaves_as` (effects of the library that act as it does), `left_out`,
    its law: `driver`, `at`, `axis`, `lines`, each with `value`, `lower` and `upper`, and its `course` over the record:
    `time_s`, `driver` and `value`."""
    add: tuple[str, ...]  # what `improve` adds, in its order: effects of the library, then free ones
    deciding_experiment: Row | None
    """Where structure is left, the test that teaches most about it: as `next_experiment_plan`, with `expected_fall`,
    the share by which the model's own standard error should fall; else None."""
    where: tuple[Row, ...]  # where the error is, as in `Comparison`
    with_all: Row  # the model with all of `missing`: the keys of `base`, and `noise_sd_nm`
    residual_check: bool | None  # whether the model's residual passes as in its `quality`; None if anything is named
    explained: float  # share, 0 to 1, of the explainable log-likelihood that the effects explain
    structure_left: float  # log-likelihood by which the residuals at work and at rest still differ
    unseen: Row | None
    """Error of the last model on held-out pulses, `rms_nm`, and the error that noise and its uncertainty allow,
    `allowed_nm`, both of means over pulse intervals; None if there are too few held-out pulses."""
    candidates: tuple[Sequence[Row], ...]
    """Effects tried in each round, best first: `effect`, `form`, `log_evidence_gain`, `rms_nm`, `forms`."""
    notes: tuple[str, ...]  # further reasons for the verdict

    @property
    def conclusion(self) -> Conclusion:
        """The verdict and the advice in words."""
        return conclude(vars(self))

    def changes(self) -> list[tuple[str, str]]:
        """The table without the effects that are refused: an id and a line for each change."""
        return [(str(row["effect"] or ""), change_words(row)) for row in self.table if row["status"] != "refused"]

    def to_dict(self) -> dict[str, Any]:
        """All fields, and `conclusion`."""
        return super().to_dict() | {"conclusion": asdict(self.conclusion)}

    def _sheet(self) -> Sheet:
        slow = quantity(self.slow_noise.get("sd_nm"), "N·m")
        rows = [
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')} white, {slow} slow, sd"),
            ("repetition", repetition_words(self.base)),
            ("the model", both_words(self.base)),
            *self.changes(),
            *[(str(row["effect"]), _read_row(row)) for row in self.missing],
        ]
        rows += [(str(row["effect"]), str(row["words"])) for row in self.free]
        if self.missing or self.free:
            rows.append(("with all", both_words(self.with_all)))
        confused = [row for row in self.missing if row["confused_with"]]
        rows += [("next test", row["next_experiment"]) for row in confused[:1]]
        rows += [("next test", str(self.deciding_experiment["text"]))] if self.deciding_experiment else []
        conclusion = self.conclusion
        # If nothing is missing, the places of the largest noise do not matter.
        places = () if conclusion.kind == "nothing" else self.where[:FEW]
        rows += _listed("error in", [row["text"] for row in places])
        rows += [("note", text) for text in self.notes] + [("", conclusion.words), ("next", conclusion.advice)]
        named = ", ".join(str(row["effect"]) for row in self.missing)
        title = f"{conclusion.title}: {named}" if named else conclusion.title
        return Sheet(f"Diagnosis: {title}{certainty(vars(self))}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Improvement(Result):
    """Models of a record, each with one more effect than the one before."""

    noise_sd_nm: float  # white measurement noise of a sample
    verdict: str  # as in `Diagnosis`, for the first model, before effects were added
    steps: tuple[Row, ...]
    """`added` (None in the first), `fit_percent`, `rms_nm`, `held_out_rms_nm`, `held_out_fit_percent`,
    `ceiling_percent`, `repetition`, `model_id`, `reason`."""
    models: tuple[Model, ...]  # one per step; the last one has all added effects
    refused: tuple[Row, ...]  # effects that were not added, best first: `effect`, `log_evidence_gain`, `reason`

    def _sheet(self) -> Sheet:
        rows = [
            (str(step["added"] or _effect_ids(model)), both_words({**model.fit, **step}))
            for step, model in zip(self.steps, self.models, strict=True)
        ]
        rows += [
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')}, sd of a sample"),
            ("repetition", repetition_words(self.steps[-1])),
        ]
        rows += [("note", text) for text in self.models[-1].reasons]
        rows += _listed("refused", [f"{row['effect']}: {row['reason']}" for row in self.refused[:FEW]])
        if len(self.refused) > FEW:
            rows.append(("", f"and {len(self.refused) - FEW} more effects"))
        added = ", ".join(str(step["added"]) for step in self.steps[1:]) or "no effect"
        before, after = (torque(step, "held_out_rms_nm") for step in (self.steps[0], self.steps[-1]))
        return Sheet(f"Improvement: {added} added, held-out error from {before} to {after}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Explanation(Result):
    """Where a model fails, what is missing, how the error falls with it, and why that ends."""

    diagnosis: Diagnosis  # of the first model
    improvement: Improvement  # the models, one effect more each
    left: Diagnosis  # of the last model
    before: Comparison  # of the first model with the record
    after: Comparison  # of the last model

    def to_dict(self) -> dict[str, Any]:
        """The keys of `explain --json`: no models, and no series for plots."""
        document: dict[str, Any] = {name: getattr(self, name).to_dict() for name in vars(self)}
        document["places"] = healed_places(document["before"], document["after"])
        for result, left_out in (("improvement", "models"), ("before", "series"), ("after", "series")):
            del document[result][left_out]
        return document | {"ended": why_ended(vars(self.left))}

    def _sheet(self) -> Sheet:
        rows, before = [("at first", self.diagnosis.conclusion.title), *self.diagnosis.changes()], self.before.to_dict()
        if self.diagnosis.conclusion.kind != "nothing" or stands_out(before):
            places = healed_places(before, self.after.to_dict())
            rows += [("failed in", f"{place['text']}: {place_words(place)}") for place in places]
        rows += _listed("free effects", [str(row["words"]) for row in self.diagnosis.free])
        for label, comparison in (("parts, at first", self.before), ("parts, at last", self.after)):
            words = contradiction_words(comparison.contradiction)
            rows += [(label, words)] if words else []
        improved = self.improvement._sheet()
        rows += [*improved.rows, ("ended", why_ended(vars(self.left)))]
        return Sheet(f"Explanation: {improved.title.partition(': ')[2]}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Carried(Result):
    """The structure of an earlier model on a new record, beside the plain structure.

    The three lists of effects are empty if the structure could not be carried over at all.
    """

    carried_from: str  # id of the earlier model
    offered: str  # "carried" or "plain": the better of the two
    why: str  # one word for programs
    reason: str  # the same as a sentence
    still_needed: tuple[str, ...]  # effects of the earlier model that the record asks for
    no_longer_needed: tuple[str, ...]  # those that it does not
    undecided: tuple[str, ...]  # those that it cannot judge, since something else is missing
    effects: tuple[Row, ...]
    """Effects of the earlier model: `effect`, `name`, `form` (in the new model; None without it), `needed` (None:
    undecided), `log_evidence_gain` (None if it was not compared), `required`, `why`, `reason`."""
    figures: tuple[Row, ...]
    """For each of `models`: `fit_percent`, `ceiling_percent`, `held_out_fit_percent`, `rms_nm`, `held_out_rms_nm`,
    `held_out_by`."""
    models: tuple[Model, ...]  # the plain one, then that with the effects that are still needed, if there are any

    @property
    def model(self) -> Model:
        """The model that is offered."""
        return self.models[-1 if self.offered == "carried" else 0]

    def finding(self) -> dict[str, Any]:
        """Return `to_dict()` without the models."""
        return {name: value for name, value in self.to_dict().items() if name != "models"}

    def _sheet(self) -> Sheet:
        rows = [("offered", f"{_effect_ids(self.model)}. {self.reason}")]
        words = {True: "still needed", False: "no longer needed", None: "left out, undecided"}
        rows += [(str(row["effect"]), f"{words[row['needed']]}. {row['reason']}") for row in self.effects]
        names = ("plain", "carried")
        rows += [(name, both_words(figures)) for name, figures in zip(names, self.figures, strict=False)]
        return Sheet(f"Structure carried over from {self.carried_from[:8]}: {self.offered} offered", tuple(rows))


def _listed(label: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    return list(zip([label, *[""] * len(texts)], texts, strict=False))


def _effect_ids(model: Model) -> str:
    return ", ".join(str(effect["id"]) for effect in model.effects) or "no effects"


def _figures(figures: Mapping[str, Any]) -> str:
    above = quantity(figures["excess_rms_nm"], "N·m")
    return f"{fit_words(figures)}, above the noise {above}, {figures['samples']} samples"


def _shares(rows: Sequence[Row]) -> str:
    """Shares of the error above the noise, largest first."""
    ranked = sorted((row for row in rows if row["share_of_excess"] > 0.005), key=lambda row: -row["share_of_excess"])
    parts = [f"{row['label']} {100 * row['share_of_excess']:.0f} %" for row in ranked]
    return f"{', '.join(parts)} of the error above the noise" if parts else "nothing above the noise"


def _read_row(row: Row) -> str:
    text = (
        f"error from {torque(row, 'rms_before_nm')} to "
        f"{torque(row, 'rms_after_nm')}, held out from {torque(row, 'held_out_rms_before_nm')} to "
        f"{torque(row, 'held_out_rms_after_nm')}"
    )
    text = "; ".join([text, *parameter_words(row["parameters"], MOST_PARAMETERS)])
    others = ", ".join(row["confused_with"])
    return f"{text}; this record cannot separate it from {others}" if others else text
