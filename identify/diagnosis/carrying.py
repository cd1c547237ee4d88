"""The structure of an earlier model on a new record: which of its effects the record still asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from stimrig.identify.diagnosis.residual import quiet_rows, residual_structure, vetoed
from stimrig.identify.diagnosis.search import Progress, prior, silent, without_effect
from stimrig.identify.diagnosis.thresholds import FIRST_MARGIN
from stimrig.identify.effects import find_effect, registry
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.effect_fit import add_effect, detected_effects, effect_names, try_effect
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.plain import fit_plain, renewed_curve
from stimrig.identify.estimation.samples import Raw, fitted_rows, prepare
from stimrig.identify.estimation.solve import Fitted
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.results import Carried

METHOD = "maximum-likelihood"
LAST = "fitting last session's structure"
FIGURES = ("fit_percent", "ceiling_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "held_out_by")
UNUSABLE = "not usable"
Reason = tuple[str, str]
"""Why something is so: as a word for programs, and as a sentence."""


@dataclass(frozen=True)
class Judged:
    """Verdict on one carried effect; `needed` is None if the record cannot tell, `gain` if it was not compared."""

    needed: bool | None
    because: Reason
    gain: float | None = None


def carry(record: Record, model: Model, progress: Progress | None = None) -> Carried:
    """Fit the structure of an earlier model to a new record, beside the plain structure, and offer the better one.

    An effect stays if the record asks for it: its log evidence, beside the other effects that stay, reaches the margin
    of a first effect, and it does not raise the error on held-out pulses (the criteria of `diagnose` and `improve`).
    Every other effect is dropped, the weakest first. If the residual of what remains has structure, something else is
    missing, and the dropped effects are undecided. Rows of `validate` are not used to fit or to choose.

    Parameters
    ----------
    record : Record
        Pulse widths and torque of the new session.
    model : Model
        Model of an earlier session. It lends its effects and their forms; all numbers are estimated anew.
    progress : callable or None
        Called with the share done, 0 to 1, and a line of text. It may raise `Cancelled`.

    Returns
    -------
    Carried
        The plain model and the one with the effects still needed, which of the two is offered, and why.

    Raises
    ------
    BadRecord, NotIdentifiable
        The record gives no model in the plain structure either.
    """
    report = progress or silent
    report(0.05, LAST)
    grid, raw = prepare(record)
    plain = fit_plain(grid, fitted_rows(grid, None))
    models, judged = [finish(METHOD, plain)], dict[str, Judged]()
    refused = _refused(model)
    if refused is not None:
        return _result(model, models, judged, False, refused)
    last = _still_needed(plain, model, raw, judged, lambda share, text: report(0.2 + 0.65 * share, text))
    if not effect_names(last):
        because = ("nothing-needed", "The plain structure is enough for this record.")
        if any(verdict.needed is None for verdict in judged.values()):
            words = "Something else than the effects of the earlier model is missing in this record."
            because = ("undecided", words)
        return _result(model, models, judged, False, because)
    report(0.85, f"{LAST}: bands and tests of the residual")
    last = renewed_curve(last)
    models.append(finish(METHOD, last, [f"effects carried over: {', '.join(effect_names(last))}"]))
    better, because = _compared(plain, last, raw)
    verdicts = [fitted.quality.get("verdict") for fitted in models]
    if better and verdicts[1] == UNUSABLE != verdicts[0]:
        words = f"The model with the carried effects is not usable. {models[1].quality.get('words') or ''}".strip()
        better, because = False, ("not-usable", words)
    report(1.0, "done")
    return _result(model, models, judged, better, because)


def _refused(model: Model) -> Reason | None:
    """Why the structure of a model cannot be carried over at all; None if it can."""
    unknown = [str(entry["id"]) for entry in model.effects if entry["id"] not in registry()]
    if unknown:
        text = (
            f"The earlier model holds {' and '.join(unknown)}, which is not installed here. Put its file back into the "
            "folder of the site's own effects (STIMRIG_EFFECTS_DIR), then fit again."
        )
        return "not-installed", text
    if model.method != METHOD:
        return "other-method", f"The earlier model was made by {model.method}, which gives no log evidence to compare."
    return None if model.effects else ("plain-before", "The earlier model has the plain structure as well.")


# ---- effects of an earlier model -----------------------------------------------------------------------------------


def _still_needed(plain: Fitted, model: Model, raw: Raw, judged: dict[str, Judged], report: Progress) -> Fitted:
    """The plain model with those effects of an earlier one that the record asks for; the verdicts go into `judged`."""
    full = _add_all(plain, model, raw, judged, lambda share, text: report(0.6 * share, text))
    last = _reduced(full, raw, judged, lambda share, text: report(0.6 + 0.4 * share, text))
    if residual_structure(last, quiet_rows(last)).significant:
        for name, verdict in judged.items():
            if not verdict.needed and verdict.gain is not None:  # what else is missing may hide what it explains
                text = (
                    f"{verdict.because[1]} But something else is missing in the model, so this record cannot tell yet."
                )
                judged[name] = replace(verdict, needed=None, because=("undecided", text))
    return last


def _add_all(plain: Fitted, model: Model, raw: Raw, judged: dict[str, Judged], report: Progress) -> Fitted:
    """The plain model with all effects of the earlier one that this record can hold; the others are judged.

    The effect that explains most is added first, then the next: a weak one that is fitted alone takes what belongs to
    the strong one. So the order in which the earlier model lists them does not matter.
    """
    fitted, remaining = plain, {str(entry["id"]): entry for entry in model.effects}
    while remaining:
        names = ", ".join(find_effect(name).name.lower() for name in remaining)
        report(1.0 - len(remaining) / len(model.effects), f"{LAST}: {names}")
        fits: dict[str, Fitted] = {}
        for name, entry in remaining.items():
            try:
                fits[name] = add_effect(fitted, find_effect(name), _form_of(entry), raw)
            except NotIdentifiable as error:
                judged[name] = Judged(False, ("not-seen", f"{error.message[:1].upper()}{error.message[1:]}."))
        if not fits:
            return fitted
        strongest = max(fits, key=lambda name: (fits[name].log_evidence, name))
        fitted = fits[strongest]
        remaining = {name: entry for name, entry in remaining.items() if name in fits and name != strongest}
    return fitted


def _form_of(entry: Mapping[str, Any]) -> str:
    """The form to fit; empty (all of them) if they are a chain, whose length depends on the record."""
    forms, name = find_effect(str(entry["id"])).forms, str(entry.get("form") or "")
    return name if name in {known.name for known in forms} and not any(known.grows for known in forms) else ""


def _reduced(full: Fitted, raw: Raw, judged: dict[str, Judged], report: Progress) -> Fitted:
    """The model without the effects that are not needed: the weakest is dropped, then the others are judged anew."""
    last, first_count, tried = full, len(effect_names(full)), set[str]()
    while present := effect_names(last):
        report(1.0 - len(present) / (first_count + 1), f"{LAST}: which of its effects are still needed")
        verdicts = {name: _judge(name, last, raw) for name in present}
        judged.update({name: verdict for name, (verdict, _) in verdicts.items()})
        weak = [name for name, (verdict, _) in verdicts.items() if not verdict.needed]
        if not weak:
            break
        worst = min(weak, key=lambda name: verdicts[name][0].gain or 0.0)
        last = verdicts[worst][1]
        if worst not in tried:
            tried.add(worst)
            other = try_effect(find_effect(worst), last)  # in its most likely form, if the evidence asks for that form
            last = other.fitted if other is not None and other.gain >= FIRST_MARGIN else last
    return last


def _judge(name: str, fitted: Fitted, raw: Raw) -> tuple[Judged, Fitted]:
    """Judge one effect of a model; return the verdict and the model without the effect."""
    if name in _in_samples(raw):
        return Judged(True, ("in-samples", "The samples show it directly, before any fit.")), fitted
    without = without_effect(fitted, name)
    gain = fitted.log_evidence - without.log_evidence + prior(find_effect(name))
    if gain < FIRST_MARGIN:
        why, words = ("against", "The evidence is against it") if gain <= 0.0 else ("weak", "Too little evidence")
        text = f"{words}: log evidence changes by {gain:+.1f} with it; at least {FIRST_MARGIN:g} is required."
        return Judged(False, (why, text), gain), without
    objection = vetoed(without, fitted)
    text = f"Log evidence is higher by {gain:.0f} with it; at least {FIRST_MARGIN:g} is required."
    return Judged(not objection, ("held-out-error", objection) if objection else ("asked-for", text), gain), without


def _in_samples(raw: Raw) -> set[str]:
    return {effect for effect, _, _ in detected_effects(raw)}


# ---- which model is offered ---------------------------------------------------------------------------------


def _compared(plain: Fitted, last: Fitted, raw: Raw) -> tuple[bool, Reason]:
    """Compare the carried structure as a whole with the plain one: True if it is better, with the reason."""
    effects = effect_names(last)
    in_samples = not _in_samples(raw).isdisjoint(effects)  # the log evidence says little of an effect that samples show
    total = last.log_evidence - plain.log_evidence + sum(prior(find_effect(name)) for name in effects)
    if total < FIRST_MARGIN and not in_samples:
        text = f"Together the effects change the log evidence by {total:+.1f}; at least {FIRST_MARGIN:g} is required."
        return False, ("no-gain", text)
    if objection := vetoed(plain, last):
        return False, ("held-out-error", objection)
    words = f"This record asks for: {'; '.join(find_effect(name).name.lower() for name in effects)}."
    return True, (
        "better",
        words if in_samples else f"{words} Log evidence is higher by {total:.0f} than without effects.",
    )


def _result(
    model: Model, models: Sequence[Model], judged: Mapping[str, Judged], better: bool, because: Reason
) -> Carried:
    forms = {str(entry["id"]): entry.get("form") for entry in models[-1].effects}
    verdicts = {str(entry["id"]): judged[str(entry["id"])] for entry in model.effects if judged}
    rows = [
        {
            "effect": name,
            "name": find_effect(name).name,
            "form": forms.get(name),
            "needed": verdict.needed,
            "log_evidence_gain": verdict.gain,
            "required": FIRST_MARGIN,
            "why": verdict.because[0],
            "reason": verdict.because[1],
        }
        for name, verdict in verdicts.items()
    ]
    needed, gone, undecided = (
        tuple(name for name, verdict in verdicts.items() if verdict.needed is answer) for answer in (True, False, None)
    )
    return Carried(
        carried_from=model.model_id,
        offered="carried" if better else "plain",
        why=because[0],
        reason=because[1],
        still_needed=needed,
        no_longer_needed=gone,
        undecided=undecided,
        effects=tuple(rows),
        figures=tuple({key: fitted.fit.get(key) for key in FIGURES} for fitted in models),
        models=(models[0], *(later.with_(extra=later.extra | {"parent": models[0].model_id}) for later in models[1:])),
    )
