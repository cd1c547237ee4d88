"""Operation: is it alive, and its figures for Prometheus."""

from __future__ import annotations

import time
from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from prometheus_client import generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from sqlalchemy import text

from stimrig.api.web.dependencies import Ctx
from stimrig.api.web.monitoring import Figures
from stimrig.api.web.responses.base import describe_answer
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
