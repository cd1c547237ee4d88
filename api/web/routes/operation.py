"""Operation: is it alive, and its figures for Prometheus."""

from __future__ import annotations

import time
from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse, PlainTextResponse, Response
from prometheus_client import generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from sqlalchemy import text

from stimrig.api import schemas
from stimrig.api.errors import NotFoundError
from stimrig.api.web.dependencies import Ctx
from stimrig.api.web.monitoring import Figures
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import SchemaOut, SchemasOut, describe_answer
from stimrig.api.web.responses.rig import HealthOut

router = APIRouter(tags=["operation"])


@router.get("/health", **describe_answer(HealthOut))
def health(context: Ctx) -> dict[str, Any]:
    """`ok` where database and rig answer; `degraded` says what does not. Holds nothing of any participant."""
    with context.store.read() as session:
        session.execute(text("SELECT 1"))
    newest = context.rig.status
    rig = {
        "connected": context.rig.connected,
        "state": newest.state if newest and context.rig.connected else "disconnected",
        "age_s": context.rig.age_s,
        "torque_age_s": newest.torque_age_s if newest else None,
    }
    return {
        "status": "ok" if context.rig.connected else "degraded",
        "database": "ok",
        "rig": rig,
        "uptime_s": round(time.monotonic() - context.started_s, 1),
    }


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(context: Ctx) -> Response:
    """Figures in Prometheus' text format."""
    return Response(generate_latest(Figures(context)), media_type=CONTENT_TYPE_PLAIN_0_0_4)


schemas_router = APIRouter(prefix="/v1/schemas", tags=["schemas"])
ONE_SCHEMA: dict[int | str, dict[str, Any]] = {
    200: {"model": SchemaOut, "description": "the schema"},
    404: problem("no schema of this name"),
}


class SchemaResponse(JSONResponse):
    """An answer that says that it is a schema."""

    media_type = "application/schema+json"


@schemas_router.get("", **describe_answer(SchemasOut))
def published() -> dict[str, Any]:
    """The schemas there are, by name, with their ids; an id ends in the version."""
    return {"schemas": {name: schemas.load(name)["$id"] for name in schemas.NAMES}}


@schemas_router.get("/{name}", response_class=SchemaResponse, response_model=None, responses=ONE_SCHEMA)
def schema(name: str) -> JSONResponse:
    """One schema, by its name or by the verb that prints it."""
    try:
        return SchemaResponse(schemas.load(name))
    except KeyError:
        raise NotFoundError("schema", name, f"There are {', '.join(schemas.NAMES)}.") from None
