"""Models: versions, approval, what the controller gets, and what its trials said of the muscle."""

from __future__ import annotations

import asyncio
from email.utils import formatdate
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response

from stimrig.api.clock import unix_of
from stimrig.api.errors import ApiError
from stimrig.api.models import stored_model
from stimrig.api.models.tracking import Limits
from stimrig.api.sessions.requests import ApprovalIn, DecisionIn
from stimrig.api.store import seen
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import PROBLEM, Approver, Context, Ctx, ModelReader
from stimrig.api.web.middleware import entity_tags
from stimrig.api.web.responses.base import answers, published
from stimrig.api.web.responses.models import VersionOut
from stimrig.api.web.responses.trend import TrackingOut
from stimrig.api.web.routes import participants

router = APIRouter(prefix="/v1", tags=["models"], responses=PROBLEM)
TAG = {"description": "send it as `If-None-Match`", "schema": {"type": "string"}}
AGE = {"description": "with `tracked`: when it was found", "schema": {"type": "string"}}
APPROVED: dict[int | str, dict[str, Any]] = {
    200: {**published("model", "MODEL.json"), "headers": {"ETag": TAG, "Last-Modified": AGE}},
    304: {"description": "it is the one of `If-None-Match`"},
}
WITH_MODEL: dict[str, Any] = {
    "description": "the version, and its MODEL.json as `model`",
    "content": {"application/json": {"schema": {"allOf": [
        {"$ref": "#/components/schemas/VersionOut"},
        {"type": "object", "required": ["model"], "properties": {"model": {"$ref": "#/components/schemas/ModelJson"}}},
    ]}}},
}  # fmt: skip


@router.get("/participants/{code}/model", response_class=Response, responses=APPROVED)
async def approved_model(
    context: Ctx, _who: ModelReader, code: str, if_none_match: Annotated[str | None, Header()] = None,
    tracked: Annotated[bool, Query(description="as tracked to the last trial, within the approved limits")] = False,
) -> Response:  # fmt: skip
    """The approved model, for the ILC controller: MODEL.json with its `ETag`; 304 where it is known already.

    With `tracked` it is the newest version that was tracked from it, with the key `tracking`; where there is none yet,
    the approved model itself. A trial that has just ended is waited for, for two seconds at most.
    """
    if tracked:
        await context.runner.trials.settled()
    served = await asyncio.to_thread(context.tracked.served if tracked else context.versions.served, code)
    if served is None:
        await asyncio.to_thread(participants.find, context, code)
        raise none_approved(code)
    headers = {"ETag": served.etag, "Cache-Control": "private, no-cache"}
    if tracked:
        headers["Last-Modified"] = formatdate(unix_of(served.at_utc), usegmt=True)
    if if_none_match and matches(if_none_match, served.etag):
        return Response(status_code=304, headers=headers)
    return Response(served.body, media_type="application/json", headers=headers)


def none_approved(code: str) -> ApiError:
    """404, with what to do."""
    detail = (
        f"Participant {code!r} has no model approved today; an approval ends with its day. "
        "POST /v1/models/{id}/approve approves one."
    )
    return ApiError(404, "no-approved-model", "No approved model", detail)


def matches(if_none_match: str, etag: str) -> bool:
    """RFC 9110, section 13.1.2: weak comparison against a list, or `*`."""
    tags = entity_tags(if_none_match)
    return "*" in tags or etag in tags


@router.get("/participants/{code}/tracking", **answers(TrackingOut))
def tracking(context: Ctx, _who: ModelReader, code: str) -> dict[str, Any]:
    """The trials since the approval that holds, oldest first; 404 where no model is approved today."""
    found = context.tracked.document(code)
    if found is None:
        participants.find(context, code)
        raise none_approved(code)
    return found


@router.get("/participants/{code}/models", response_model=list[VersionOut])
def versions(context: Ctx, _who: ModelReader, code: str) -> list[dict[str, Any]]:
    """A participant's model versions, newest first, with their errors and what each added."""
    participants.find(context, code)
    return context.versions.of(code)


@router.get("/models/{model_id}", response_model=None, responses={200: WITH_MODEL})
def one_model(context: Ctx, _who: ModelReader, model_id: str, response: Response) -> dict[str, Any]:
    """A version: its errors, its verdict, its lineage, and the model."""
    row = context.versions.get(model_id)
    response.headers["ETag"] = context.store.etag(
        context.clock, f"/v1/models/{model_id}", seen.decisions(row.participant)
    )
    return {**context.versions.document(row), "model": stored_model.read(row)}


@router.get("/models/{model_id}/file", response_class=Response, responses={200: published("model", "MODEL.json")})
def model_file(context: Ctx, _who: ModelReader, model_id: str) -> Response:
    """MODEL.json, as it was stored."""
    row = context.versions.get(model_id)
    headers = {"Content-Disposition": f'attachment; filename="{row.id}.json"', "ETag": f'"{row.etag}"'}
    return Response(stored_model.whole(row), media_type="application/json", headers=headers)


@router.post("/models/{model_id}/approve", response_model=VersionOut)
async def approve(context: Ctx, who: Approver, model_id: str, body: ApprovalIn | None = None) -> dict[str, Any]:
    """Let the controller have this version, and what is tracked from it within limits, until the day ends."""
    given = body or ApprovalIn()
    row = await let_have(context, model_id, who.name, given.reason, given.tracking.limits())
    return await asyncio.to_thread(context.versions.document, row)


async def let_have(context: Context, model_id: str, by: str, reason: str, tracking: Limits) -> Model:
    """Approve a version; the worker that follows its trials is warm by the first one."""
    row = await asyncio.to_thread(context.versions.get, model_id)
    await asyncio.to_thread(context.versions.decide, model_id, True, by, reason, tracking)
    context.runner.trials.warm(row.participant)
    return row


@router.post("/models/{model_id}/reject", response_model=VersionOut)
def reject(context: Ctx, who: Approver, model_id: str, body: DecisionIn | None = None) -> dict[str, Any]:
    """Keep this version from the controller."""
    context.versions.decide(model_id, False, who.name, body.reason if body else "")
    return context.versions.document(context.versions.get(model_id))


@router.post("/models/{model_id}/undo", response_model=VersionOut)
def undo(context: Ctx, who: Approver, model_id: str, body: DecisionIn | None = None) -> dict[str, Any]:
    """Go back to the version this one was made from; nothing is deleted."""
    parent = context.versions.undo(model_id, who.name, body.reason if body else "")
    return context.versions.document(parent)
