"""How far a model may be tracked, as a person types it with the approval, and as it is shown afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from starlette.datastructures import FormData

from api.errors import ApiError
from api.language import _, lazy, localised
from api.models.tracking import QUANTITIES, Limits
from api.web.pages import typed
from api.web.pages.environment import environment

LABELS = {
    "gain_percent": lazy("Gain (± %%)"),
    "threshold_percent": lazy("Threshold (± %%)"),
    "time_scale_percent": lazy("Time scale (± %%)"),
}


def read(sent: FormData) -> Limits:
    """The limits that were typed; the usual ones where the form has no such field.

    Raises
    ------
    ApiError
        422: what was typed is no percentage from 0 to 60.
    """
    found: dict[str, float] = {}
    for name in Limits().to_dict():
        text = sent.get(name)
        if text is None:
            continue
        try:
            found[name] = typed.number(str(text))
        except ValueError as error:
            detail = f"{name}: {error}. Nothing was decided."
            raise ApiError(422, "invalid-input", "This value cannot be used", detail) from None
    return Limits(**found)


def fields(sent: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """The form's fields, with what was typed in them."""
    given = {name: typed.shown(percent) for name, percent in Limits().to_dict().items()} | dict(sent or {})
    return [{"name": name, "label": str(label), "text": str(given[name])[:5]} for name, label in LABELS.items()]


def words(limits: Mapping[str, Any] | None, threshold_us: float | None) -> str:
    """What is allowed, in a sentence.

    Parameters
    ----------
    limits : mapping or None
        Of `LABELS`, each in percent, or as it was typed; None: the usual ones.
    threshold_us : float or None
        Of the model's curve, µs; without one its threshold stays as approved, whatever the limit.
    """
    given = {
        name: typed.number(str(value)) if isinstance(value, str) else value for name, value in (limits or {}).items()
    }
    allowed = Limits(**given)
    bounds = allowed.bounds(threshold_us)
    if not bounds:
        return _("The model does not follow the muscle from trial to trial: all stays as approved.")
    said = {
        quantity: f"±{localised(typed.shown(percent))}\u00a0%" if quantity in bounds else _("as approved")
        for quantity, percent in zip(QUANTITIES, allowed.to_dict().values(), strict=True)
    }
    if shift_us := bounds.get("threshold_shift_us", (0.0, 0.0))[1]:
        said["threshold_shift_us"] += localised(f" (±{shift_us:.3g}\u00a0µs)")
    return _(
        "The model follows the muscle from trial to trial, at most: gain %(gain)s, threshold %(threshold)s, "
        "time scale %(time_scale)s.",
        gain=said["gain"], threshold=said["threshold_shift_us"], time_scale=said["time_scale"],
    )  # fmt: skip


environment.globals["tracking_fields"] = fields
environment.globals["tracking_words"] = words
