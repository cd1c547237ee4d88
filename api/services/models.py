"""Models: approval, and pulse widths for a reference within the limits of participant and rig."""

from __future__ import annotations

import asyncio
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.models.tracking import Limits
from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import tighter
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model, Participant


async def approve(context: Context, row: Model, by: str, reason: str, tracking: Limits, tags: Tags) -> int:
    """Approve a version; the worker that follows its trials is warm by the first one."""
    version = await asyncio.to_thread(context.versions.decide, row.id, True, by, reason, tracking, tags=tags)
    context.runner.trials.warm(row.participant)
    return version


def none_approved(code: str) -> ApiError:
    """404, with what to do."""
    detail = (
        f"Participant {code!r} has no model approved today; an approval ends with its day. "
        "POST /v1/models/{id}/approve approves one."
    )
    return ApiError(404, "no-approved-model", "No approved model", detail)


async def invert(
    context: Context, model_id: str, reference: dict[str, Any], width_us: float | None = None,
    rise_us: float | None = None, whole: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Invert a model for a reference torque, within the limits of participant and rig.

    `reference`: the torque to follow, as the verb `invert` takes it; `width_us`, `rise_us`: further limits.
    """
    text = await asyncio.to_thread(context.tracked.text_of, model_id)
    version = await asyncio.to_thread(context.tracked.version_of, model_id)
    participant: Participant = await asyncio.to_thread(context.store.get, Participant, version.participant)
    largest_us = tighter(width_us, participant.profile.get("max_pulse_width_us"))
    rig = context.rig.status
    bound, shortest_us = (rig.limits.get(RISE), rig.stimulator.get("shortest_us")) if rig else (None, None)
    rise_us = tighter(rise_us, bound and bound.hi)
    call = context.pool.submit(
        "invert", urgent=True, model_json=text, largest_us=largest_us, rise_us=rise_us, whole=whole,
        shortest_us=shortest_us or 0.0, **reference,
    )  # fmt: skip
    inverted = await call.result
    limits = {"max_pulse_width_us": largest_us, "max_rise_us": rise_us, "shortest_pulse_us": shortest_us}
    return {"model_id": model_id, **inverted, **limits, "segments": segments(inverted["pulse_width_us"])}


def segments(pulse_width_us: list[float]) -> list[dict[str, Any]]:
    """Return a trial of these widths between two rests, for `POST /v1/tests`."""
    rest = {"name": "rest", "sequence": "rest", "settings": {"duration_s": REST_S}}
    return [rest, {"name": "trial", "sequence": "widths", "settings": {"pulse_width_us": pulse_width_us}}, rest]


RISE = "width_rise_us"


REST_S = 1.0
"""Before and after a trial: its torque is measured against the rest before it."""
