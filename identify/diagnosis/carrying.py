"""The structure of an earlier model on a new record: which of its effects the record still asks for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from stimrig.identify.diagnosis.residual import quiet_rows, residual_structure, vetoed
from stimrig.identify.diagnosis.search import Progress, prior, silent, without_effect
from stimrig.identify.diagnosis.thresholds import FIRST_MARGIN
from stimrig.identify.effects import Effect, find_effect, registry
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.effect_fit import add_effect, detected_effects, effect_names, try_effect
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.plain import fit_plain, renewed_curve
from stimrig.identify.estimation.samples import Raw, fitted_rows, prepare
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.results import Carried

METHOD = "maximum-likelihood"
LAST = "fitting last session's structure"
FIGURES = ("fit_percent", "ceiling_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "held_out_by")
UNUSABLE = "not usable"


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
    plain_model = finish(METHOD, plain)
    refused = _refused(model)
    if refused is not None:
        return _result(model, [plain_model], [], False, refused)
    last, judged = still_needed(plain, model, raw, lambda share, text: report(0.2 + 0.65 * share, text))
    rows = [judged[str(entry["id"])] for entry in model.effects]
    if not effect_names(last):
        return _result(model, [plain_model], rows, False, _nothing(rows))
    report(0.85, f"{LAST}: bands and tests of the residual")
    last = renewed_curve(last)
    carried_model = finish(METHOD, last, [f"effects carried over: {', '.join(effect_names(last))}"])
    better, because = _verdict(plain, last, raw)
    if better and (against := _less_usable(plain_model, carried_model)):
        better, because = False, against
    report(1.0, "done")
    return _result(model, [plain_model, carried_model], rows, better, because)


def _refused(model: Model) -> Reason | None:
    """Why the structure of a model cannot be carried over at all; None if it can."""
    unknown = [str(entry["id"]) for entry in model.effects if entry["id"] not in registry()]
    if unknown:
        text = (
            f"The earlier model holds {' and '.join(unknown)}, which is not installed here. Put its file back into the "
            "folder of the site's own effects (STIMRIG_EFFECTS_DIR), then fit again."
        )
        return Reason("not-installed", text)
    if model.method != METHOD:
        text = f"The earlier model was made by {model.method}, which gives no log evidence to compare."
        return Reason("other-method", text)
    return None if model.effects else Reason("plain-before", "The earlier model has the plain structure as well.")


# ---- effects of an earlier model -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reason:
    """Why something is so: as a word for programs, and as a sentence."""

    why: str
    reason: str


@dataclass(frozen=True)
class Judged:
    """Verdict on one carried effect; `needed` is None if the record cannot tell, `gain` if it was not compared."""

    effect: Effect
    needed: bool | None
    because: Reason
    gain: float | None = None


def still_needed(plain: Fitted, model: Model, raw: Raw, report: Progress) -> tuple[Fitted, dict[str, Judged]]:
    """The plain model with those effects of an earlier one that the record asks for, and the verdict on each.

    `plain` is the plain structure on the new record, `raw` what its samples show before any fit; `model`, the earlier
    one, lends its effects and their forms.
    """
    judged: dict[str, Judged] = {}
    full = _add_all(plain, model, raw, judged, lambda share, text: report(0.6 * share, text))
    last = _reduced(full, raw, judged, lambda share, text: report(0.6 + 0.4 * share, text))
    if residual_structure(last, quiet_rows(last)).significant:
        judged = {name: _undecided(verdict) for name, verdict in judged.items()}
    return last, judged


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
                reason = Reason("not-seen", f"{error.message[:1].upper()}{error.message[1:]}.")
                judged[name] = Judged(find_effect(name), False, reason)
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
    detected = {effect for effect, _, _ in detected_effects(raw)}
    last, first_count, tried = full, len(effect_names(full)), set[str]()
    while present := effect_names(last):
        report(1.0 - len(present) / (first_count + 1), f"{LAST}: which of its effects are still needed")
        verdicts = [_judged(find_effect(name), last, name in detected) for name in present]
        judged.update({verdict.effect.id: verdict for verdict, _ in verdicts})
        weak = [pair for pair in verdicts if not pair[0].needed]
        if not weak:
            break
        worst, last = min(weak, key=lambda pair: pair[0].gain or 0.0)
        if worst.effect.id not in tried:
            tried.add(worst.effect.id)
            other = try_effect(worst.effect, last)  # in its most likely form, if the evidence asks for that form
            last = other.fitted if other is not None and other.gain >= FIRST_MARGIN else last
    return last


def _judged(effect: Effect, fitted: Fitted, detected: bool) -> tuple[Judged, Fitted]:
    """Judge one effect of a model; return the verdict and the model without the effect."""
    if detected:
        return Judged(effect, True, Reason("in-samples", "The samples show it directly, before any fit.")), fitted
    without = without_effect(fitted, effect.id)
    gain = fitted.log_evidence - without.log_evidence + prior(effect)
    if gain < FIRST_MARGIN:
        why, words = ("against", "The evidence is against it") if gain <= 0.0 else ("weak", "Too little evidence")
        text = f"{words}: log evidence changes by {gain:+.1f} with it; at least {FIRST_MARGIN:g} is required."
        return Judged(effect, False, Reason(why, text), gain), without
    risen = rise(without, fitted)
    text = f"Log evidence is higher by {gain:.0f} with it; at least {FIRST_MARGIN:g} is required."
    return Judged(effect, risen is None, risen or Reason("asked-for", text), gain), without


def rise(before: Fitted, after: Fitted) -> Reason | None:
    """The error on held-out pulses as a reason if it rises; else None."""
    objection = vetoed(before, after)
    return Reason("held-out-error", objection) if objection else None


def _undecided(verdict: Judged) -> Judged:
    """The verdict on an effect if something else is missing in the model: it may hide what the effect explains."""
    if verdict.needed or verdict.gain is None:
        return verdict
    text = f"{verdict.because.reason} But something else is missing in the model, so this record cannot tell yet."
    return replace(verdict, needed=None, because=Reason("undecided", text))


# ---- which model is offered ---------------------------------------------------------------------------------


def _nothing(judged: list[Judged]) -> Reason:
    """Why no effect is left."""
    if any(verdict.needed is None for verdict in judged):
        return Reason("undecided", "Something else than the effects of the earlier model is missing in this record.")
    return Reason("nothing-needed", "The plain structure is enough for this record.")


def _verdict(plain: Fitted, last: Fitted, raw: Raw) -> tuple[bool, Reason]:
    """Compare the carried structure as a whole with the plain one: True if it is better, with the reason."""
    carried_effects = effect_names(last)
    # The log evidence says little of an effect that the samples show.
    in_samples = any(effect in carried_effects for effect, _, _ in detected_effects(raw))
    total = last.log_evidence - plain.log_evidence + sum(prior(find_effect(name)) for name in carried_effects)
    if total < FIRST_MARGIN and not in_samples:
        text = f"Together the effects change the log evidence by {total:+.1f}; at least {FIRST_MARGIN:g} is required."
        return False, Reason("no-gain", text)
    risen = rise(plain, last)
    if risen is not None:
        return False, risen
    names = "; ".join(find_effect(name).name.lower() for name in carried_effects)
    if in_samples:
        return True, Reason("better", f"This record asks for: {names}.")
    text = f"This record asks for: {names}. Log evidence is higher by {total:.0f} than without effects."
    return True, Reason("better", text)


def _less_usable(plain: Model, carried: Model) -> Reason | None:
    """The reason if the carried model may not be used while the plain one may."""
    if carried.quality.get("verdict") != UNUSABLE or plain.quality.get("verdict") == UNUSABLE:
        return None
    words = str(carried.quality.get("words") or "")
    return Reason("not-usable", f"The model with the carried effects is not usable. {words}".strip())


def _result(model: Model, models: list[Model], judged: list[Judged], better: bool, because: Reason) -> Carried:
    forms = {str(entry["id"]): entry.get("form") for entry in models[-1].effects}
    models[1:] = [later.with_(extra=later.extra | {"parent": models[0].model_id}) for later in models[1:]]
    rows = [
        {
            "effect": verdict.effect.id,
            "name": verdict.effect.name,
            "form": forms.get(verdict.effect.id),
            "needed": verdict.needed,
            "log_evidence_gain": verdict.gain,
            "required": FIRST_MARGIN,
            "why": verdict.because.why,
            "reason": verdict.because.reason,
        }
        for verdict in judged
    ]
    return Carried(
        carried_from=model.model_id,
        offered="carried" if better else "plain",
        why=because.why,
        reason=because.reason,
        still_needed=tuple(verdict.effect.id for verdict in judged if verdict.needed),
        no_longer_needed=tuple(verdict.effect.id for verdict in judged if verdict.needed is False),
        undecided=tuple(verdict.effect.id for verdict in judged if verdict.needed is None),
        effects=tuple(rows),
        figures=tuple({key: fitted.fit.get(key) for key in FIGURES} for fitted in models),
        models=tuple(models),
    )
