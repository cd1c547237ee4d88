"""The structure of an earlier model on a new record: which of its effects the record still asks for."""

from __future__ import annotations

from stimrig.identify.diagnosis.search import LAST, Judged, Progress, Reason, prior, rise, silent, still_needed
from stimrig.identify.diagnosis.thresholds import FIRST_MARGIN
from stimrig.identify.effects import get, registry
from stimrig.identify.estimation.effect_fit import detected_effects, effect_names, renewed_curve
from stimrig.identify.estimation.finish import finish
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.plain import fit_plain, fitted_rows, prepare
from stimrig.identify.estimation.samples import Raw
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.results import Carried

METHOD = "maximum-likelihood"
FIGURES = ("fit_percent", "ceiling_percent", "held_out_fit_percent", "rms_nm", "held_out_rms_nm", "held_out_by")
UNUSABLE = "not usable"


def carry(record: Record, model: Model, progress: Progress | None = None) -> Carried:
    """Fit the structure of an earlier model to a new record, beside the plain structure, and offer the better one.

    An effect stays if the record asks for it: its log evidence, beside the other effects that stay, reaches the margin
    of a first effect, and it does not raise the error on held-out rows (the criteria of `diagnose` and `improve`).
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
    say = progress or silent
    say(0.05, LAST)
    grid, raw = prepare(record)
    plain = fit_plain(grid, fitted_rows(grid, None))
    plain_model = finish(METHOD, plain)
    refused = _refused(model)
    if refused is not None:
        return _result(model, [plain_model], [], False, refused)
    last, judged = still_needed(plain, model, raw, lambda share, text: say(0.2 + 0.65 * share, text))
    rows = [judged[str(entry["id"])] for entry in model.effects]
    if not effect_names(last):
        return _result(model, [plain_model], rows, False, _nothing(rows))
    say(0.85, f"{LAST}: bands and tests of the residual")
    last = renewed_curve(last)
    carried_model = finish(METHOD, last, [f"effects carried over: {', '.join(effect_names(last))}"])
    better, because = _verdict(plain, last, raw)
    if better and (against := _less_usable(plain_model, carried_model)):
        better, because = False, against
    say(1.0, "done")
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


# ---- which model is offered ---------------------------------------------------------------------------------


def _nothing(judged: list[Judged]) -> Reason:
    """Why no effect is left."""
    if any(one.needed is None for one in judged):
        return Reason("undecided", "Something else than the effects of the earlier model is missing in this record.")
    return Reason("nothing-needed", "The plain structure is enough for this record.")


def _verdict(plain: Fitted, last: Fitted, raw: Raw) -> tuple[bool, Reason]:
    """Whether the carried structure as a whole is better than the plain one, and why."""
    held = effect_names(last)
    # The log evidence says little of an effect that the samples show.
    in_samples = any(effect in held for effect, _, _ in detected_effects(raw))
    total = last.log_evidence - plain.log_evidence + sum(prior(get(name)) for name in held)
    if total < FIRST_MARGIN and not in_samples:
        text = f"Together the effects change the log evidence by {total:+.1f}; at least {FIRST_MARGIN:g} is required."
        return False, Reason("no-gain", text)
    risen = rise(plain, last)
    if risen is not None:
        return False, risen
    names = "; ".join(get(name).name.lower() for name in held)
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
    models[1:] = [one.with_(extra=one.extra | {"parent": models[0].model_id}) for one in models[1:]]
    rows = [
        {
            "effect": one.effect.id,
            "name": one.effect.name,
            "form": forms.get(one.effect.id),
            "needed": one.needed,
            "log_evidence_gain": one.gain,
            "required": FIRST_MARGIN,
            "why": one.because.why,
            "reason": one.because.reason,
        }
        for one in judged
    ]
    return Carried(
        carried_from=model.model_id,
        offered="carried" if better else "plain",
        why=because.why,
        reason=because.reason,
        still_needed=tuple(one.effect.id for one in judged if one.needed),
        no_longer_needed=tuple(one.effect.id for one in judged if one.needed is False),
        undecided=tuple(one.effect.id for one in judged if one.needed is None),
        effects=tuple(rows),
        figures=tuple({key: one.fit.get(key) for key in FIGURES} for one in models),
        models=tuple(models),
    )
