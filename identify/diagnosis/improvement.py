"""Adding what is missing, one effect after the other, while the evidence lasts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from identify.diagnosis import structure_of
from identify.diagnosis.analysis import MOST, Analysis, analyse
from identify.diagnosis.candidates import Progress
from identify.diagnosis.steps import Step, steps
from identify.diagnosis.unseen import rise
from identify.diagnosis.verdict import judge
from identify.effects import get
from identify.estimation.adding import add, names
from identify.estimation.finish import finish
from identify.estimation.prepare import Raw
from identify.estimation.statistics import statistics
from identify.model import Model
from identify.records.record import Record
from identify.results import Improvement

COLUMNS = ("fit_percent", "rms_nm", "held_out_rms_nm", "held_out_fit_percent")


def improve(
    record: Record,
    progress: Progress | None = None,
    max_effects: int | None = None,
    force: Sequence[str] = (),
    model: Model | None = None,
) -> Improvement:
    """Models of a record, each with one effect more, up to as many as are there.

    Parameters
    ----------
    record : Record
        Pulse widths and torque.
    progress : callable or None
        Called with a share of 0 to 1 and a line of text.
    max_effects : int or None
        Effects at most.
    force : sequence of str
        Effects that a person wants added although the record doesn't ask for them; the held-out error then shows it.
    model : Model or None
        Whose structure is added to, fitted anew; the plain Hammerstein structure where none is given.

    Returns
    -------
    Improvement
        The steps, each with its model (`extra["parent"]` is its forebear's id) and its reason, and what was refused.

    Raises
    ------
    BadRequest
        A forced effect is unknown, or effects do not stand on the model given.
    NotIdentifiable
        A forced effect needs a column that the record lacks, or nothing in the record looks like it.
    """
    for effect in force:
        get(effect)
    most = MOST if max_effects is None else min(max_effects, MOST)
    work = analyse(record, progress, most=most, structure=structure_of(model))
    verdict = judge(work)
    row, against = helpful(work)
    if max_effects is not None:
        row = row[: max_effects + 1]
    reasons = [_reason(work, step) for step in row]
    for effect in force:
        step = _forced(row[-1], effect, work.raw)
        if step is not None:
            row.append(step)
            reasons.append("Added because a person asked for it; the record doesn't.")
    models = _models(row)
    return Improvement(
        noise_sd_nm=work.raw.noise_sd_nm,
        verdict=verdict.kind,
        steps=tuple(
            {"added": step.added}
            | {key: step.figures[key] for key in COLUMNS}
            | {"model_id": model.model_id, "reason": reason, "ceiling_percent": step.figures["ceiling_percent"]}
            for step, model, reason in zip(row, models, reasons, strict=True)
        ),
        models=tuple(models),
        refused=(*against, *refused(work)),
    )


def helpful(work: Analysis) -> tuple[list[Step], list[dict[str, Any]]]:
    """The steps up to the first after which the error on rows not seen rises; and what is refused for that."""
    row = steps(work)
    for number in range(1 + len(work.given), len(row)):
        errors = rise(row[number - 1].fitted, row[number].fitted)
        if errors is not None:
            reason = f"The error on rows not seen would rise from {errors[0]:.3g} to {errors[1]:.3g} N·m."
            return row[:number], [{"effect": row[number].added, "log_evidence_gain": None, "reason": reason}]
    return row, []


def _reason(work: Analysis, step: Step) -> str:
    if step.added is None:
        held = ", ".join(get(name).name.lower() for name in names(work.base))
        return f"As given, with {held}." if held else "Recruitment and linear dynamics alone."
    if step.added in work.given:
        return "Seen in the raw samples."
    number = work.added.index(step.added)
    gain = next(c.gain for c in work.rounds[number] if c.effect.id == step.added)
    return f"Log evidence rises by {gain:.0f}; {work.margins[number]:.3g} would do."


def refused(work: Analysis) -> list[dict[str, Any]]:
    """Effects that were tried on the last model and not added, best first, with the reason."""
    present = set(names(work.last))
    if not work.rounds:
        return []
    number = min(len(work.added), len(work.rounds) - 1)
    margin = work.margins[number] if number < len(work.margins) else 0.0
    rows = []
    for candidate in work.rounds[number]:
        if candidate.effect.id in present:
            continue
        if candidate.gain <= 0.0:
            reason = f"The record speaks against it: log evidence {candidate.gain:+.1f}."
        elif candidate.gain < margin:
            reason = (
                f"Too little speaks for it: log evidence {candidate.gain:+.1f}, at least {margin:.0f} is asked for."
            )
        else:
            reason = "Another effect explains the same better."
        rows.append({"effect": candidate.effect.id, "log_evidence_gain": candidate.gain, "reason": reason})
    return rows


def _forced(last: Step, effect: str, raw: Raw) -> Step | None:
    if effect in names(last.fitted):
        return None
    fitted = add(last.fitted, get(effect), "", raw)
    return Step(effect, fitted, statistics(fitted))


def _models(row: list[Step]) -> list[Model]:
    models: list[Model] = []
    for number, step in enumerate(row):
        parent = models[-1].model_id if models else None
        model = finish("maximum-likelihood", step.fitted, figures=step.figures)
        models.append(model.with_(extra=model.extra | {"parent": parent, "added": step.added, "step": number}))
    return models
