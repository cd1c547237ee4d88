"""Models: versions, approval, what the controller gets, what its trials said of the muscle; a trial foretold."""

from __future__ import annotations

import asyncio
from email.utils import formatdate
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response

from stimrig.api.clock import unix_of
from stimrig.api.errors import ApiError
from stimrig.api.models import stored_model
from stimrig.api.services import models, participants
from stimrig.api.services.context import Context
from stimrig.api.services.models import ReferenceIn, WidthsIn
from stimrig.api.sessions.requests import ApprovalIn, DecisionIn
from stimrig.api.store.tables import Participant
from stimrig.api.web.dependencies import (
    PROBLEM,
    Approver,
    Ctx,
    DecisionVersion,
    ModelReader,
    RejectionVersion,
    Version,
)
from stimrig.api.web.middleware import entity_tags
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import InversionOut, PredictionOut, TrackingOut, VersionOut

router = APIRouter(prefix="/v1", tags=["models"], responses=PROBLEM)
TAG = {"description": "send it as `If-None-Match`", "schema": {"type": "string"}}
AGE = {"description": "with `tracked`: when it was found", "schema": {"type": "string"}}
MODEL = {"$ref": "#/components/schemas/ModelJson"}
MODEL_JSON = {"description": "MODEL.json", "content": {"application/json": {"schema": MODEL}}}
APPROVED: dict[int | str, dict[str, Any]] = {
    200: {**MODEL_JSON, "headers": {"ETag": TAG, "Last-Modified": AGE}},
    304: {"description": "it is the one of `If-None-Match`"},
}
WITH_MODEL: dict[str, Any] = {
    "description": "the version, and its MODEL.json as `model`",
    "content": {"application/json": {"schema": {"allOf": [
        {"$ref": "#/components/schemas/VersionOut"},
        {"type": "object", "required": ["model"], "properties": {"model": MODEL}},
    ]}}},
}  # fmt: skip


@router.get("/participants/{code}/model", response_class=Response, responses=APPROVED)
async def approved_model(
    context: Ctx, _principal: ModelReader, code: str, if_none_match: Annotated[str, Header()] = "",
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
        raise await asyncio.to_thread(none_approved, context, code)
    headers = {"ETag": served.etag, "Cache-Control": "private, no-cache"}
    if tracked:
        headers["Last-Modified"] = formatdate(unix_of(served.at_utc), usegmt=True)
    if {"*", served.etag} & {*entity_tags(if_none_match)}:  # RFC 9110, section 13.1.2
        return Response(status_code=304, headers=headers)
    return Response(served.body, media_type="application/json", headers=headers)


@router.get("/participants/{code}/tracking", **describe_answer(TrackingOut))
def tracking(context: Ctx, _principal: ModelReader, code: str) -> dict[str, Any]:
    """The trials since the approval that holds, oldest first; 404 where no model is approved today."""
    document = context.tracked.document(code)
    if document is None:
        raise none_approved(context, code)
    return document


def none_approved(context: Context, code: str) -> ApiError:
    """404, with what to do; that of the participant where there is none."""
    participants.find(context, code)
    detail = (
        f"Participant {code!r} has no model approved today; an approval ends with its day. "
        "POST /v1/models/{id}/approve approves one."
    )
    return ApiError(404, "no-approved-model", "No approved model", detail)


@router.get("/participants/{code}/models", response_model=list[VersionOut])
def versions(context: Ctx, _principal: ModelReader, code: str) -> list[dict[str, Any]]:
    """A participant's model versions, newest first, with their errors and what each added."""
    participants.find(context, code)
    return context.versions.of(code)


@router.get("/models/{model_id}", response_model=None, responses={200: WITH_MODEL})
def one_model(context: Ctx, _principal: ModelReader, row: Version, response: Response) -> dict[str, Any]:
    """A version: its errors, its verdict, its lineage, and the model."""
    participant: Participant = context.store.get(Participant, row.participant)  # read first: it is not newer
    response.headers["ETag"] = f'"{participant.version}"'  # what is decided on one model is decided on all
    return {**context.versions.document(row), "model": stored_model.read(row)}


@router.get("/models/{model_id}/file", response_class=Response, responses={200: MODEL_JSON})
def model_file(_principal: ModelReader, row: Version) -> Response:
    """MODEL.json, as it was stored."""
    headers = {"Content-Disposition": f'attachment; filename="{row.id}.json"', "ETag": f'"{row.etag}"'}
    return Response(stored_model.whole(row), media_type="application/json", headers=headers)


@router.post("/models/{model_id}/approve", response_model=VersionOut)
async def approve(
    context: Ctx, principal: Approver, model_id: str, tags: DecisionVersion, response: Response,
    body: ApprovalIn | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Let the controller have this version, and what is tracked from it within limits, until the day ends."""
    approval, decide = body or ApprovalIn(), context.versions.decide
    version = await asyncio.to_thread(
        decide, model_id, True, principal.name, approval.reason, approval.tracking, tags=tags
    )
    response.headers["ETag"] = f'"{version}"'
    row = await asyncio.to_thread(context.versions.get, model_id)
    context.runner.trials.warm(row.participant)  # the worker that follows its trials is warm by the first one
    return await asyncio.to_thread(context.versions.document, row)


@router.post("/models/{model_id}/reject", response_model=VersionOut)
def reject(
    context: Ctx, principal: Approver, model_id: str, tags: RejectionVersion, response: Response,
    body: DecisionIn | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Keep this version from the controller. Without `If-Match`: on what is decided now, and without an `ETag`."""
    version = context.versions.decide(model_id, False, principal.name, body.reason if body else "", tags=tags)
    if tags is not None:  # else what others decided would pass for what was read
        response.headers["ETag"] = f'"{version}"'
    return context.versions.document(context.versions.get(model_id))


@router.post("/models/{model_id}/prediction", **describe_answer(PredictionOut))
async def prediction(context: Ctx, _principal: ModelReader, model_id: str, body: WidthsIn) -> dict[str, Any]:
    """Mean torque the pulses give in each pulse's period, N·m, after a second of rest; effects included.

    Of a version, or of one that was tracked from it (its `model_id`).
    """
    return await models.predict(context, model_id, body)


@router.post("/models/{model_id}/widths", **describe_answer(InversionOut))
async def widths(context: Ctx, _principal: ModelReader, model_id: str, body: ReferenceIn) -> dict[str, Any]:
    """The pulse widths whose predicted torque follows a reference best, and where and why it is out of reach.

    Of a version, or of one that was tracked from it (its `model_id`).
    """
    return await models.invert(context, model_id, body)
