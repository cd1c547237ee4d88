"""What comparing, diagnosing and improving find: typed, with the keys of `--json`; api/schemas says each with its unit.

Rows of tables are dicts; their keys are those of the schema. `to_dict()` is plain JSON. A result shows itself: `print`
gives about ten lines, `repr` one, a notebook a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypedDict

from identify.caution import caution
from identify.model import Model
from identify.plain_json import plain
from identify.shown import Sheet, Shown, both_words, fit_words, probability, quantity, torque

Row = Mapping[str, Any]
VERDICTS = {
    "effect_missing": "an effect is missing",
    "nothing_missing": "nothing is missing",
    "unexplained_structure": "structure is left that no effect of the library explains",
}
GOES_WITH = {"residual": "itself", "u": "the pulse width", "u2": "the pulse width's square", "y": "the torque"}
FEW = 3
"""Rows of a long table that a summary shows."""


class Figures(TypedDict):
    """How well a model fits some rows; NaN where the torque never changes there."""

    fit_percent: float
    ceiling_percent: float
    rms_nm: float
    excess_rms_nm: float
    samples: int


class _Result(Shown):
    def to_dict(self) -> dict[str, Any]:
        """All fields as plain lists, numbers and texts; null where a number is none."""
        return {item.name: _document(getattr(self, item.name)) for item in fields(self)}  # pyright: ignore[reportArgumentType]


def _document(value: Any) -> Any:
    if isinstance(value, tuple) and any(isinstance(item, Model) for item in value):
        return [item.to_dict() for item in value]
    return plain(value)


@dataclass(frozen=True, repr=False, eq=False)
class Comparison(_Result):
    """A model against a measurement.

    Parameters
    ----------
    fit_percent, ceiling_percent : float
        Best fit of all rows, and what the true system would reach on this noise, %.
    rms_nm, excess_rms_nm : float
        Error of all rows, and what of it is above the noise, N·m.
    samples : int
        Rows.
    noise_sd_nm : float
        White measurement noise of a sample, N·m.
    fitted : Figures
        The same figures on rows that may be fitted.
    held_out : Figures or None
        And on rows of `validate`; None without any.
    by : dict of list of dict
        The error by "segment", "level" of pulse width, "direction", "time" and "frequency"; each row has `label`,
        `rms_nm` and `share_of_excess`.
    tests : dict
        Correlations of the residual: `lags_s`, `false_alarm_rate`, `innovations`, and `tests`, each with `with`,
        `values`, `band`, `largest`, `at_lag_s`, `passed`, `words`.
    where : tuple of dict
        Worst places first: `segment`, `start_s`, `end_s`, `pulse_width_us`, `direction`, `share_of_excess`,
        `mean_error_nm`, `text`.
    series : dict
        What a plot needs, thinned: `time_s`, `torque_nm`, `predicted_torque_nm`, `lower_nm`, `upper_nm`, `residual_nm`,
        `pulse_width_us`, `segment`, `noise_band_nm`.
    left_out : str
        How much was not counted, and why; empty where all is known.
    plain : tuple of str
        Sentences for people.
    """

    fit_percent: float
    ceiling_percent: float
    rms_nm: float
    excess_rms_nm: float
    samples: int
    noise_sd_nm: float
    fitted: Figures
    held_out: Figures | None
    by: Mapping[str, Sequence[Row]]
    tests: Row
    where: tuple[Row, ...]
    series: Row
    left_out: str
    plain: tuple[str, ...]

    def _sheet(self) -> Sheet:
        whole: Figures = {
            "fit_percent": self.fit_percent,
            "ceiling_percent": self.ceiling_percent,
            "rms_nm": self.rms_nm,
            "excess_rms_nm": self.excess_rms_nm,
            "samples": self.samples,
        }
        alarms = [GOES_WITH.get(test["with"], str(test["with"])) for test in self.tests["tests"] if not test["passed"]]
        rows = [
            ("all rows", _figures(whole)),
            ("fitted rows", _figures(self.fitted)),
            ("held out", "no rows of `validate`" if self.held_out is None else _figures(self.held_out)),
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')}, sd of a sample"),
            ("residual", f"not noise: goes with {', '.join(alarms)}" if alarms else "noise: no correlation stands out"),
        ]
        rows += [("worst place" if number == 0 else "", row["text"]) for number, row in enumerate(self.where[:FEW])]
        rows += [(f"by {kind}", _shares(self.by[kind])) for kind in ("segment", "direction") if self.by.get(kind)]
        reached, most = quantity(self.fit_percent, "%"), quantity(self.ceiling_percent, "%")
        return Sheet(f"Comparison: fit {reached} where the noise allows {most}", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(_Result):
    """What is missing in the model of a record.

    Parameters
    ----------
    noise_sd_nm : float
        White measurement noise of a sample, N·m.
    slow_noise : dict
        `sd_nm`, and `ar1`, the correlation of neighbouring pulse intervals.
    base : dict
        The model of the structure that was criticised: `fit_percent`, `rms_nm`, `ceiling_percent`, each with a
        `held_out_` one beside it, and `held_out_by`, where those come from.
    verdict : str
        "effect_missing", "nothing_missing" or "unexplained_structure".
    probability : float
        Of the verdict, 0 to 1.
    missing : tuple of dict
        Effects, most probable first: `effect`, `name`, `probability`, errors before and after, `confused_with`,
        `next_experiment` (words) and `next_experiment_plan`, `form`, `equation`, `parameters`, `rival_probabilities`,
        `plain`.
    where : tuple of dict
        Where the error sits, as in `Comparison`.
    with_all : dict
        The model with all of `missing`: the keys of `base`, and `noise_sd_nm`.
    explained : float
        Share, 0 to 1, of the explicable log-likelihood that the effects took.
    structure_left : float
        Log-likelihood by which work and rest still differ.
    unseen : dict or None
        Error of the last model on rows not seen, `rms_nm`, and what noise and its own uncertainty allow, `allowed_nm`,
        both of means over a pulse interval; None where those rows can say nothing.
    candidates : tuple of list of dict
        What was tried in each round, best first: `effect`, `form`, `log_evidence_gain`, `rms_nm`, `forms`.
    notes : tuple of str
        Reasons that no figure shows.
    plain : tuple of str
        Sentences for people.
    """

    noise_sd_nm: float
    slow_noise: Row
    base: Row
    verdict: str
    probability: float
    missing: tuple[Row, ...]
    where: tuple[Row, ...]
    with_all: Row
    explained: float
    structure_left: float
    unseen: Row | None
    candidates: tuple[Sequence[Row], ...]
    notes: tuple[str, ...]
    plain: tuple[str, ...]

    def _sheet(self) -> Sheet:
        slow = quantity(self.slow_noise.get("sd_nm"), "N·m")
        rows = [
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')} white, {slow} slow, sd"),
            ("the model", both_words(self.base)),
            *[(str(row["effect"]), _found(row)) for row in self.missing],
        ]
        if self.missing:
            rows.append(("with all", both_words(self.with_all)))
        told = [row for row in self.missing if row["confused_with"]]
        rows += [("next test", row["next_experiment"]) for row in told[:1]]
        # Where nothing is missing the worst of the noise is no place to look at.
        places = () if self.verdict == "nothing_missing" else self.where[:FEW]
        rows += [("error sits" if number == 0 else "", row["text"]) for number, row in enumerate(places)]
        rows += [("note", text) for text in (*self.notes, caution(vars(self))) if text]
        verdict = VERDICTS.get(self.verdict, self.verdict)
        named = "".join(f", {row['effect']}" for row in self.missing)
        return Sheet(f"Diagnosis: {verdict}{named} (probability {probability(self.probability)})", tuple(rows))


@dataclass(frozen=True, repr=False, eq=False)
class Improvement(_Result):
    """Models of a record, each with one effect more than the one before.

    Parameters
    ----------
    noise_sd_nm : float
        White measurement noise of a sample, N·m.
    verdict : str
        As in `Diagnosis`: on the first of the models, before anything was added.
    steps : tuple of dict
        `added` (None in the first), `fit_percent`, `rms_nm`, `held_out_rms_nm`, `held_out_fit_percent`,
        `ceiling_percent`, `model_id`, `reason`.
    models : tuple of Model
        One a step; the last one holds all that was added.
    refused : tuple of dict
        Effects that were not added, best first: `effect`, `log_evidence_gain`, `reason`.
    """

    noise_sd_nm: float
    verdict: str
    steps: tuple[Row, ...]
    models: tuple[Model, ...]
    refused: tuple[Row, ...]

    def _sheet(self) -> Sheet:
        rows = [
            (str(step["added"] or _held(model)), both_words({**model.fit, **step}))
            for step, model in zip(self.steps, self.models, strict=True)
        ]
        rows += [
            ("noise", f"{quantity(self.noise_sd_nm, 'N·m')}, sd of a sample"),
            ("at first", VERDICTS.get(self.verdict, self.verdict)),
        ]
        rows += [
            ("refused" if number == 0 else "", f"{row['effect']}: {row['reason']}")
            for number, row in enumerate(self.refused[:FEW])
        ]
        if len(self.refused) > FEW:
            rows.append(("", f"and {len(self.refused) - FEW} effects more"))
        added = ", ".join(str(step["added"]) for step in self.steps[1:]) or "no effect"
        before, after = (torque(step, "held_out_rms_nm") for step in (self.steps[0], self.steps[-1]))
        return Sheet(f"Improvement: {added} added, held-out rms from {before} to {after}", tuple(rows))


def _held(model: Model) -> str:
    return ", ".join(str(effect["id"]) for effect in model.effects) or "no effects"


def _figures(figures: Figures) -> str:
    above = quantity(figures["excess_rms_nm"], "N·m")
    return f"{fit_words(figures)}, above the noise {above}, {figures['samples']} samples"


def _shares(rows: Sequence[Row]) -> str:
    """Where the error above the noise sits, largest part first."""
    ranked = sorted((row for row in rows if row["share_of_excess"] > 0.005), key=lambda row: -row["share_of_excess"])
    parts = [f"{row['label']} {100 * row['share_of_excess']:.0f} %" for row in ranked]
    return f"{', '.join(parts)} of the error above the noise" if parts else "nothing above the noise"


def _found(row: Row) -> str:
    text = (
        f"probability {probability(row['probability'])}, rms from {torque(row, 'rms_before_nm')} to "
        f"{torque(row, 'rms_after_nm')}, held out from {torque(row, 'held_out_rms_before_nm')} to "
        f"{torque(row, 'held_out_rms_after_nm')}"
    )
    others = ", ".join(row["confused_with"])
    return f"{text}; this record can't tell it from {others}" if others else text
