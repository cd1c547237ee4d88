"""Add the missing effects one after the other, as long as the evidence is sufficient."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from stimrig.identify.criticism import compare
from stimrig.identify.diagnosis import search_for
from stimrig.identify.diagnosis.changes import reason_against
from stimrig.identify.diagnosis.result import diagnosis_of
from stimrig.identify.diagnosis.search import EffectSearch, Progress, Step, helpful
from stimrig.identify.diagnosis.verdict import judge
from stimrig.identify.effects import find_effect
from stimrig.identify.estimation.candidates import likelihood_warnings, words
from stimrig.identify.estimation.effect_fit import add_effect, effect_names
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.left_out import difference, from_to, hold_out
from stimrig.identify.estimation.samples import Raw
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
    return _improvement_of(search_for(record, model, progress), max_effects, force)


def explain(record: Record, progress: Progress | None = None, model: Model | None = None) -> Explanation:
    """Say where the model of a record fails, what it lacks, how its error falls with that, and why that ends.

    All of it comes from one search.

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
    diagnoses, improvement = diagnose_and_improve(record, progress, model)
    before, after = (compare(compared, record) for compared in (improvement.models[0], improvement.models[-1]))
    return Explanation(diagnosis=diagnoses[0], improvement=improvement, left=diagnoses[-1], before=before, after=after)


def diagnose_and_improve(
    record: Record, progress: Progress | None = None, model: Model | None = None
) -> tuple[list[Diagnosis], Improvement]:
    """Return what `improve` gives, and the diagnosis of each of its models, from one search.

    Parameters and errors are those of `improve`.

    Parameters
    ----------
    record : Record
        The measurement.
    progress : callable, optional
        Called with a share of 0 to 1 and a line of text; what it raises ends the work.
    model : Model, optional
        To begin with; default: the plain one.
    """
    search = search_for(record, model, progress)
    improvement = _improvement_of(search)
    diagnoses = [diagnosis_of(search.from_step(number)) for number in range(len(improvement.models))]
    if progress is not None:
        progress(1.0, "done")
    return diagnoses, improvement


def _improvement_of(search: EffectSearch, max_effects: int | None = None, force: Sequence[str] = ()) -> Improvement:
    supported, against = helpful(search)
    steps = supported if max_effects is None else supported[: max_effects + 1]
    models, rows = [], []
    for number, step in enumerate(_with_forced(steps, force, search.raw)):
        reasons = likelihood_warnings(step.fitted)
        model = finish("maximum-likelihood", step.fitted, reasons, statistics=step.statistics)
        parent = models[-1].model_id if models else None
        lineage = {"parent": parent, "added": step.added, "step": search.number + number}
        models.append(model.with_(extra=model.extra | lineage | {"begun_with": list(search.begun_with)}))
        reason = _reason(search, steps[number - 1], step, models[-1]) if number < len(steps) else FORCED
        rows.append(
            {"added": step.added}
            | {key: step.statistics.get(key) for key in COLUMNS}
            | {"model_id": model.model_id, "reason": reason, "ceiling_percent": step.statistics["ceiling_percent"]}
        )
    return Improvement(
        noise_sd_nm=search.raw.noise_sd_nm,
        verdict=judge(search).kind,
        steps=tuple(rows),
        models=tuple(models),
        refused=(*against, *refused(search)),
    )


FREE = "A free effect: it describes what no effect of the library explains, and names no cause."
FORCED = "Added on request. The evidence does not ask for it."


def _with_forced(steps: Sequence[Step], force: Sequence[str], raw: Raw) -> Iterator[Step]:
    """The steps, and one more for each effect to be added whatever the evidence says."""
    yield from steps
    last = steps[-1].fitted
    for effect in force:
        if effect not in effect_names(last):
            last = add_effect(last, find_effect(effect), "", raw)
            yield Step(effect, last, "library")


def _reason(search: EffectSearch, before: Step, step: Step, model: Model) -> str:
    if step.added is None:
        names = ", ".join(find_effect(name).name.lower() for name in search.base_effects)
        base = (
            f"The given structure, with {names}."
            if names
            else "The plain structure: recruitment curve and linear dynamics."
        )
        return " ".join([base, *words(step.fitted, search.rows)])
    if step.origin == "detected":
        return "The samples show it directly, before any fit."
    comparison = difference(before.left_out, step.left_out)
    if step.origin == "free":
        described = next(
            (entry["shape"] for entry in model.effects if entry["id"] == step.added and "shape" in entry), {}
        )
        description = described.get("words", f"{find_effect(step.added).name}.")
        return " ".join([description, comparison.words_of_choice, FREE, *likelihood_warnings(step.fitted)])
    gain = next(candidate.gain for candidate in step.tried if candidate.effect.id == step.added)
    margin = search.margin(search.names("library").index(step.added))
    reasons = [f"Log evidence rises by {gain:.0f}; at least {margin:.3g} is required.", comparison.words]
    if not find_effect(step.added).predictable:
        reasons.append("It cannot be foreseen: it need not predict.")
    old_nm, new_nm = before.statistics["held_out_rms_nm"], step.statistics["held_out_rms_nm"]
    if before.statistics["held_out_by"] == HELD_OUT and new_nm > old_nm:
        about_zero = difference(hold_out(before.fitted), hold_out(step.fitted))
        reasons.append(
            f"On held-out pulses the error {from_to(old_nm, new_nm)}; about the zero of each piece of them it "
            f"{about_zero.change}."
        )
    return " ".join(reasons)


def refused(search: EffectSearch) -> list[dict[str, Any]]:
    """Effects that were tried last and not added, best first, each with the reason."""
    return [
        {
            "effect": candidate.effect.id,
            "log_evidence_gain": candidate.gain,
            "reason": reason_against(search, candidate),
        }
        for candidate in (search.rounds[-1] if search.rounds else ())
        if candidate.effect.id not in effect_names(search.last)
    ]
