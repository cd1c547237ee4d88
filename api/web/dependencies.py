"""Dependencies of routes and pages: the service's context, the requester, and the versions of decisions."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import Depends, Query, Security
from starlette.requests import HTTPConnection

from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services.context import Context
from stimrig.api.services.decisions import Decision
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import Model
from stimrig.api.web.guards import Press, anyone_who_may_stop, if_match, require
from stimrig.api.web.openapi import problem


async def context_of(connection: HTTPConnection) -> Context:
    """The application's context; not in a worker thread: a stop waits for none of them."""
    return connection.app.state.context


Confirm = Annotated[str, Query(max_length=64, description="`confirm.token` of the 409 that asked for it")]
Ctx = Annotated[Context, Depends(context_of)]
Anyone = Annotated[Principal, Depends(require())]
MayStop = Annotated[Press, Depends(anyone_who_may_stop)]
LiveReader = Annotated[Principal, Security(require(Scope.READ_LIVE), scopes=[Scope.READ_LIVE])]
Tester = Annotated[Principal, Security(require(Scope.RUN_TEST), scopes=[Scope.RUN_TEST])]
Rearmer = Annotated[Principal, Security(require(Scope.REARM), scopes=[Scope.REARM])]
Approver = Annotated[Principal, Security(require(Scope.APPROVE_MODEL), scopes=[Scope.APPROVE_MODEL])]
ModelReader = Annotated[Principal, Security(require(Scope.READ_MODEL), scopes=[Scope.READ_MODEL])]
Administrator = Annotated[Principal, Security(require(Scope.ADMINISTER), scopes=[Scope.ADMINISTER])]

ParticipantVersion = Annotated[Tags, if_match("/v1/participants/{code}")]
CalibrationVersion = Annotated[Tags, if_match("/v1/participants/{code}/calibration")]
DecisionVersion = Annotated[Tags, if_match("/v1/models/{model_id}")]
RejectionVersion = Annotated[Tags | None, if_match("/v1/models/{model_id}", needed=False)]
UserVersion = Annotated[Tags, if_match("/v1/users")]
LatchVersion = Annotated[Tags, if_match("/v1/rig")]
AngleVersion = Annotated[Tags, if_match("/v1/rig/angle")]


async def _decision(principal: Tester, tags: ParticipantVersion, confirm: Confirm = "") -> Decision:
    return Decision(principal.name, tags, confirm, on_page=principal.csrf is not None)


ParticipantDecision = Annotated[Decision, Depends(_decision)]
"""Decision of someone who may test; a person signed in must confirm where a second look is needed (409, `confirm`)."""


async def _version(context: Ctx, model_id: str) -> Model:
    return await asyncio.to_thread(context.versions.get, model_id)


Version = Annotated[Model, Depends(_version)]
"""The model version of the path's `model_id`; after who asks for it, so that only they hear that there is none."""

PROBLEM: dict[int | str, dict[str, Any]] = {
    code: problem(text)
    for code, text in {
        401: "not signed in", 403: "the scope or the form's token is missing", 404: "not there",
        409: "in conflict with what is", 422: "does not hold: `errors` names the fields",
        503: "the rig cannot be reached, or too much at once",
    }.items()
}  # fmt: skip
"""Problems of every route that asks who comes."""
