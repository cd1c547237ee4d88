"""Which effects of an earlier model a new record still asks for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from stimrig.identify.diagnosis.held_out_error import held_out_rise
from stimrig.identify.diagnosis.residual_structure import quiet_rows, residual_structure
from stimrig.identify.diagnosis.search import without_effect
from stimrig.identify.diagnosis.thresholds import FIRST_MARGIN
from stimrig.identify.effects import get
from stimrig.identify.effects.base import Effect
from stimrig.identify.errors import NotIdentifiable
from stimrig.identify.estimation.effect_fit import BAND_COST, add_effect, detected_effects, effect_names, try_effect
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.estimation.samples import Raw
from stimrig.identify.model import Model

LAST = "fitting last session's structure"


@dataclass(frozen=True)
class Reason:
    """Why something is so: as a word for programs, and as a sentence."""

    why: str
    reason: str


@dataclass(frozen=True)
class Judged:
    """What a record says of one carried effect: None if it cannot tell. `gain` is None if it was not compared."""

    effect: Effect
    needed: bool | None
    because: Reason
    gain: float | None = None


def still_needed(
    plain: Fitted, model: Model, raw: Raw, say: Callable[[float, str], None]
) -> tuple[Fitted, dict[str, Judged]]:
    """The plain model with those effects of an earlier one that the record asks for, and the verdict on each.

    Parameters
    ----------
    plain : Fitted
        The plain structure on the new record.
    model : Model
        The earlier model. It lends its effects and their forms.
    raw : Raw
        What the samples of the new record show before any fit.
    say : callable
        Called with the share done and a line of text.
    """
    judged: dict[str, Judged] = {}
    full = _with_all(plain, model, raw, judged, lambda share, text: say(0.6 * share, text))
    last = _reduced(full, raw, judged, lambda share, text: say(0.6 + 0.4 * share, text))
    if residual_structure(last, quiet_rows(last), raw.noise_sd_nm).left:
        judged = {name: _undecided(verdict) for name, verdict in judged.items()}
    return last, judged


def _with_all(
    plain: Fitted, model: Model, raw: Raw, judged: dict[str, Judged], say: Callable[[float, str], None]
) -> Fitted:
    """The plain model with all effects of the earlier one that this record can hold; the others are judged.

    The effect that explains most is added first, then the next: a weak one that is fitted alone takes what belongs to
    the strong one. So the order in which the earlier model lists them does not matter.
    """
    fitted, left = plain, {str(entry["id"]): entry for entry in model.effects}
    while left:
        say(1.0 - len(left) / len(model.effects), f"{LAST}: {_names(left)}")
        found = {name: _added(fitted, name, entry, raw, judged) for name, entry in left.items()}
        held = {name: one for name, one in found.items() if one is not None}
        if not held:
            return fitted
        strongest = max(held, key=lambda name: (held[name].log_evidence, name))
        fitted = held[strongest]
        left = {name: entry for name, entry in left.items() if name in held and name != strongest}
    return fitted


def _names(ids: Iterable[str]) -> str:
    return ", ".join(get(name).name.lower() for name in ids)


def _added(fitted: Fitted, name: str, entry: Mapping[str, Any], raw: Raw, judged: dict[str, Judged]) -> Fitted | None:
    """The model with one more effect of the earlier one; None, and judged, if the record cannot hold it."""
    effect = get(name)
    try:
        return add_effect(fitted, effect, _form(effect, entry), raw)
    except NotIdentifiable as error:
        seen = Reason("not-seen", f"{error.message[:1].upper()}{error.message[1:]}.")
        judged[effect.id] = Judged(effect, False, seen)
        return None


def _form(effect: Effect, entry: Mapping[str, Any]) -> str:
    """The form to fit; empty (all of them) if they are a chain, whose length depends on the record."""
    form = str(entry.get("form") or "")
    growing = any(known.grows for known in effect.forms)
    return form if not growing and form in {known.name for known in effect.forms} else ""


def _reduced(full: Fitted, raw: Raw, judged: dict[str, Judged], say: Callable[[float, str], None]) -> Fitted:
    """The model without the effects that are not needed: the weakest is dropped, then the others are judged anew."""
    shown = {effect for effect, _, _ in detected_effects(raw)}
    last, first_count, tried = full, len(effect_names(full)), set[str]()
    while held := effect_names(last):
        say(1.0 - len(held) / (first_count + 1), f"{LAST}: which of its effects are still needed")
        found = [_judged(get(name), last, name in shown) for name in held]
        judged.update({verdict.effect.id: verdict for verdict, _ in found})
        weak = [pair for pair in found if not pair[0].needed]
        if not weak:
            break
        worst, last = min(weak, key=lambda pair: pair[0].gain or 0.0)
        if worst.effect.id not in tried:
            tried.add(worst.effect.id)
            last = _in_another_form(worst.effect, last) or last
    return last


def _judged(effect: Effect, fitted: Fitted, shown: bool) -> tuple[Judged, Fitted]:
    """What the record says of an effect of a model, and the model without it."""
    if shown:
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


def prior(effect: Effect) -> float:
    """What is added to a gain of log evidence: the effect's prior odds, and the cost of a narrow band."""
    return effect.prior - (BAND_COST if effect.band else 0.0)


def rise(before: Fitted, after: Fitted) -> Reason | None:
    """The error on held-out rows as a reason if it rises; else None."""
    errors = held_out_rise(before, after)
    if errors is None:
        return None
    text = f"The error on held-out rows rises from {errors[0]:.3g} to {errors[1]:.3g} N·m."
    return Reason("held-out-error", text)


def _in_another_form(effect: Effect, without: Fitted) -> Fitted | None:
    """The model with the effect in its most likely form, if the evidence asks for that form."""
    found = try_effect(effect, without)
    return found.fitted if found is not None and found.gain >= FIRST_MARGIN else None


def _undecided(verdict: Judged) -> Judged:
    """The verdict on an effect if something else is missing in the model: it may hide what the effect explains."""
    if verdict.needed or verdict.gain is None:
        return verdict
    text = f"{verdict.because.reason} But something else is missing in the model, so this record cannot tell yet."
    return replace(verdict, needed=None, because=Reason("undecided", text))
