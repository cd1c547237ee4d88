"""Add the missing effects one after the other, as long as the evidence is sufficient."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stimrig.identify.criticism import compare
from stimrig.identify.diagnosis import diagnose, structure_of
from stimrig.identify.diagnosis.free import searched
from stimrig.identify.diagnosis.result import diagnosis_of
from stimrig.identify.diagnosis.search import MAX_EFFECTS, EffectSearch, Progress, Step, helpful, silent
from stimrig.identify.diagnosis.thresholds import RISE
from stimrig.identify.diagnosis.verdict import Verdict
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.candidates import words
from stimrig.identify.estimation.effect_fit import add_effect, effect_names
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.fit_statistics import evaluate
from stimrig.identify.estimation.left_out import difference
from stimrig.identify.estimation.samples import Raw, prepare
from stimrig.identify.model import Model
from stimrig.identify.records.record import HELD_OUT, Record
from stimrig.identify.results import Diagnosis, Explanation, Improvement

COLUMNS = ("fit_percent", "rms_nm", "held_out_rms_nm", "held_out_fit_percent", "repetition", "unforeseen_nm")


def improve(
    record: Record,
    progress: Progress | None = None,
    max_effects: int | None = None,
    force: Sequence[str] = (),
    model: Model | None = None,
) -> Improvement:
    """Fit models to a record, each with one effect more, until no further effect is needed.

    Parameters
    ----------
    record : Record
        Pulse widths and torque.
    progress : callable or None
        Called with the share done, 0 to 1, and a line of text. It may raise `Cancelled`.
    max_effects : int or None
        Effects to add at most.
    force : sequence of str
        Effects to add although the evidence does not ask for them. The held-out error shows what they do.
    model : Model or None
        Effects are added to its structure, which is fitted again. Without a model: to the plain structure.

    Returns
    -------
    Improvement
        The steps, each with its model (`extra["parent"]` is the id of the model before) and its reason, and the
        effects that were not added.

    Raises
    ------
    BadRequest
        A forced effect is unknown, or effects cannot be added to the given model.
    NotIdentifiable
        Less than three seconds may be fitted; or a forced effect needs a column that the record does not have, or its
        fit finds nothing to start from.
    """
    for effect in force:
        find_effect(effect)
    limit = MAX_EFFECTS if max_effects is None else min(max_effects, MAX_EFFECTS)
    structure = structure_of(model)
    grid, raw = prepare(record)
    search, verdict = searched(grid, raw, progress, max_effects=limit, structure=structure)
    return _improvement_of(search, verdict, max_effects, force)


def explain(record: Record, progress: Progress | None = None, model: Model | None = None) -> Explanation:
    """Compare, diagnose, improve, compare and diagnose again: how the model of a record was improved, and why.

    Parameters
    ----------
    record, progress, model
        As `improve` takes them.

    Returns
    -------
    Explanation
        The diagnoses of the first and of the last model, the improvement, and both models compared with the record.

    Raises
    ------
    BadRequest, NotIdentifiable
        As `improve` and `diagnose` raise them.
    """
    report = progress or silent
    diagnosis, improvement = diagnose_and_improve(record, lambda share, text: report(0.6 * share, text), model)
    first, last = improvement.models[0], improvement.models[-1]
    remaining = diagnosis
    if last is not first:  # a further search tries all forms beside what was added, as one of the last model would
        remaining = diagnose(record, last, lambda share, text: report(0.6 + 0.4 * share, text))
    before, after = (compare(compared, record) for compared in (first, last))
    report(1.0, "done")
    return Explanation(diagnosis=diagnosis, improvement=improvement, left=remaining, before=before, after=after)


def diagnose_and_improve(
    record: Record, progress: Progress | None = None, model: Model | None = None
) -> tuple[Diagnosis, Improvement]:
    """Return the results of `diagnose` and `improve` from one search. Parameters and errors are those of `improve`.

    Parameters
    ----------
    record : Record
        The measurement.
    progress : callable, optional
        Called with a share of 0 to 1 and a line of text; what it raises ends the work.
    model : Model, optional
        To begin with; default: the plain one.
    """
    structure = structure_of(model)
    grid, raw = prepare(record)
    search, verdict = searched(grid, raw, progress, structure=structure)
    return diagnosis_of(search, verdict), _improvement_of(search, verdict)


def _improvement_of(
    search: EffectSearch, verdict: Verdict, max_effects: int | None = None, force: Sequence[str] = ()
) -> Improvement:
    row, against = helpful(search)
    if max_effects is not None:
        row = row[: max_effects + 1]
    supported_steps = len(row)
    for effect in force:
        step = _forced(row[-1], effect, search.raw)
        if step is not None:
            row.append(step)
    models = _models(row)
    reasons = [_reason(search, *three) for three in zip(row[:supported_steps], [row[0], *row], models, strict=False)]
    reasons += ["Added on request. The evidence does not ask for it."] * (len(row) - supported_steps)
    return Improvement(
        noise_sd_nm=search.raw.noise_sd_nm,
        verdict=verdict.kind,
        steps=tuple(
            {"added": step.added}
            | {key: step.statistics.get(key) for key in COLUMNS}
            | {"model_id": model.model_id, "reason": reason, "ceiling_percent": step.statistics["ceiling_percent"]}
            for step, model, reason in zip(row, models, reasons, strict=True)
        ),
        models=tuple(models),
        refused=(*against, *refused(search)),
    )


FREE = "A free effect: it describes what no effect of the library explains, and names no cause."
_PLAIN = "The plain structure: recruitment curve and linear dynamics."


def _reason(search: EffectSearch, step: Step, before: Step, model: Model) -> str:
    if step.added is None:
        base_names = ", ".join(find_effect(name).name.lower() for name in effect_names(search.base))
        base = f"The given structure, with {base_names}." if base_names else _PLAIN
        return " ".join([base, *words(step.fitted, search.rows)])
    if step.added in search.detected:
        return "The samples show it directly, before any fit."
    number = search.added.index(step.added)
    comparison = difference(search.left_out[number], search.left_out[number + 1])
    if step.added in search.free:
        description = next(effect["shape"]["words"] for effect in model.effects if effect["id"] == step.added)
        return " ".join([description, comparison.words_of_choice, FREE])
    gain = next(c.gain for c in search.rounds[number] if c.effect.id == step.added)
    reason = f"Log evidence rises by {gain:.0f}; at least {search.margins[number]:.3g} is required."
    unasked = [] if find_effect(step.added).predictable else ["It cannot be foreseen: it need not predict."]
    return " ".join([reason, comparison.words, *unasked, *_rising(before.statistics, step.statistics)])


def _rising(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Return a sentence if the held-out error rises, but not enough to refuse the effect."""
    rises = before["held_out_by"] == HELD_OUT and after["held_out_rms_nm"] > RISE * before["held_out_rms_nm"]
    return ["On held-out pulses the error rises, but not by more than its standard error."] if rises else []


def refused(search: EffectSearch) -> list[dict[str, Any]]:
    """Effects that were tried on the last model and not added, best first, each with the reason."""
    present = set(effect_names(search.last))
    if not search.rounds:
        return []
    number = min(len(search.added), len(search.rounds) - 1)
    margin = search.margins[number] if number < len(search.margins) else 0.0
    rows = []
    for candidate in search.rounds[number]:
        if candidate.effect.id in present:
            continue
        if candidate.refusal is not None:
            reason = candidate.refusal
        elif candidate.gain <= 0.0:
            reason = f"The evidence is against it: log evidence changes by {candidate.gain:+.1f}."
        elif candidate.gain < margin:
            reason = (
                f"Too little evidence: log evidence rises by {candidate.gain:.1f}; at least {margin:g} is required."
            )
        else:
            reason = "Another effect explains the same error better."
        rows.append({"effect": candidate.effect.id, "log_evidence_gain": candidate.gain, "reason": reason})
    return rows


def _forced(last: Step, effect: str, raw: Raw) -> Step | None:
    if effect in effect_names(last.fitted):
        return None
    fitted = add_effect(last.fitted, find_effect(effect), "", raw)
    return Step(effect, fitted, evaluate(fitted))


def _models(row: list[Step]) -> list[Model]:
    models: list[Model] = []
    for number, step in enumerate(row):
        parent = models[-1].model_id if models else None
        model = finish("maximum-likelihood", step.fitted, statistics=step.statistics)
        models.append(model.with_(extra=model.extra | {"parent": parent, "added": step.added, "step": number}))
    return models
