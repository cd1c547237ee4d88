"""How far a model may be tracked, as a person types it with the approval, and as it is shown afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from starlette.datastructures import FormData

from api.errors import ApiError
from api.language import _, lazy
from api.models.tracking import LEAST_PERCENT, MOST_PERCENT, Limits
from api.web.pages import typed
from api.web.pages.environment import environment, number

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
            found[name] = percent = typed.number(str(text))
        except ValueError as error:
            raise refused(name, str(error)) from None
        if not (LEAST_PERCENT <= percent <= MOST_PERCENT):
            raise refused(name, f"{percent:g} % is not from {LEAST_PERCENT:g} to {MOST_PERCENT:g} %")
    return Limits(**found)


def refused(name: str, why: str) -> ApiError:
    """422, in one line."""
    return ApiError(422, "invalid-input", "This value cannot be used", f"{name}: {why}. Nothing was decided.")


def fields(sent: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """The form's fields, with what was typed in them."""
    given = {name: typed.shown(percent) for name, percent in Limits().to_dict().items()} | dict(sent or {})
    return [{"name": name, "label": str(label), "text": str(given[name])[:5]} for name, label in LABELS.items()]


def words(limits: Mapping[str, float]) -> str:
    """What is allowed, in a sentence."""
    said = {name: _("not tracked") if not limits[name] else "±" + number(limits[name], 0, "%") for name in LABELS}
    if not any(limits.values()):
        return _("It is not tracked from trial to trial.")
    return _(
        "Tracked from trial to trial: gain %(gain)s, threshold %(threshold)s, time scale %(time_scale)s.",
        gain=said["gain_percent"], threshold=said["threshold_percent"], time_scale=said["time_scale_percent"],
    )  # fmt: skip


environment.globals["tracking_fields"] = fields
environment.globals["tracking_words"] = words
