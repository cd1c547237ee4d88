"""Participants across rigs, their sessions and models."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import Response

from stimrig.api.centre import clean, directory, handed_out
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.directory import Search
from stimrig.api.centre.responses import ParticipantsOut, SessionsOut
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.models.summary import VERDICTS
from stimrig.api.store.centre_tables import CentreModel
from stimrig.api.web.dependencies import PROBLEM, ModelReader
from stimrig.api.web.responses.base import answers

router = APIRouter(prefix="/v1", tags=["participants"], responses=PROBLEM)
Day = Annotated[str | None, Query(description="a day, as 2026-11-23")]
VERDICT_NAMES = (*VERDICTS, "unknown")


def asked(
    context: Context, q: str = "", rig: str | None = None, from_: str | None = None, to: str | None = None,
    effect: str | None = None, verdict: str | None = None, after: str | None = None,
) -> Search:  # fmt: skip
    """A search, each part checked.

    Raises
    ------
    ApiError
        422: a part does not hold; 404: no such rig.
    """
    for name, given in (("from", from_), ("to", to)):
        if given and clean.a_day(given) is None:
            raise ApiError(422, "invalid-input", "The request is not valid", f"{name}: give a day as 2026-11-23")
    if effect and not clean.EFFECT.fullmatch(effect):
        raise ApiError(422, "invalid-input", "The request is not valid", "effect: give an effect's id, as fatigue")
    if verdict and verdict not in VERDICT_NAMES:
        raise ApiError(422, "invalid-input", "The request is not valid", f"verdict: one of {', '.join(VERDICT_NAMES)}")
    if after and clean.code(after) is None:
        raise ApiError(422, "invalid-input", "The request is not valid", "after: give it as the last page gave it")
    rig_id = the_rig(context, rig).id if rig else None
    return Search(q.strip()[:32], rig_id, from_ or None, to or None, effect or None, verdict or None, after or "")


def the_rig(context: Context, name: str) -> Any:
    """A rig by its name. Raises NotFoundError."""
    found = context.rigs.named(name[:80])
    if found is None:
        raise NotFoundError("rig", name[:80], "GET /v1/rigs lists them.")
    return found


@router.get("/participants", **answers(ParticipantsOut))
def participants(
    context: Ctx, _who: ModelReader, q: Annotated[str, Query(max_length=32, description="the code begins so")] = "",
    rig: str | None = None, from_: Annotated[str | None, Query(alias="from", description="a day")] = None,
    to: Day = None, effect: str | None = None, verdict: str | None = None, after: str | None = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> dict[str, Any]:  # fmt: skip
    """Participants by code; of a session between the days with the verdict, and with a model that holds the effect."""
    search = asked(context, q, rig, from_, to, effect, verdict, after)
    if search.q and not clean.CODE.fullmatch(search.q):
        return {"participants": [], "after": None}
    found, last = directory.participants(context.store, search, limit)
    return {"participants": found, "after": last}


@router.get("/participants/{code}/sessions", **answers(SessionsOut))
def sessions(
    context: Ctx, _who: ModelReader, code: str, before: str | None = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> dict[str, Any]:  # fmt: skip
    """A participant's sessions over all rigs, newest first."""
    if not directory.person(context.store, code[:40]):
        raise NotFoundError("participant", code[:40], "GET /v1/participants lists them.")
    found, more = directory.sessions(context.store, code, page_key(before), limit)
    plain = ("made_tests", "made_recordings", "models", "decisions", "rig_id")
    listed = [{name: value for name, value in one.items() if name not in plain} for one in found]
    return {"participant": code, "sessions": listed, "before": f"{more[0]}~{more[1]}" if more else None}


def page_key(before: str | None) -> tuple[str, int] | None:
    """Where a page of sessions begins. Raises ApiError (422)."""
    if not before:
        return None
    day, _, number = before.partition("~")
    if clean.a_day(day) is None or (number and (not number.isdecimal() or len(number) > 9)):
        raise ApiError(422, "invalid-input", "The request is not valid", "before: give it as the last page gave it")
    return day, int(number or 0)


@router.get("/rigs/{rig}/models/{model_id}/file", response_class=Response)
async def model_file(context: Ctx, _who: ModelReader, rig: str, model_id: str) -> Response:
    """MODEL.json, as the rig made it; refused where it differs from its hash."""
    key = (await asyncio.to_thread(the_rig, context, rig)).id, model_id[:64]
    row = await asyncio.to_thread(context.store.get, CentreModel, key)
    if row is None:
        raise NotFoundError("model", model_id[:64])
    return await handed_out.file(context, row.file, f"{row.participant}-{row.id}.json", "application/json")
