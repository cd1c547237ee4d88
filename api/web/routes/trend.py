"""A participant's sessions over time."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from stimrig.api.models.trend import newest_changes, sessions
from stimrig.api.services import participants
from stimrig.api.web.dependencies import PROBLEM, Ctx, ModelReader
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.models import TrendOut

router = APIRouter(prefix="/v1/participants/{code}", tags=["trend"], responses=PROBLEM)


@router.get("/trend", **describe_answer(TrendOut))
def trend(context: Ctx, _principal: ModelReader, code: str) -> dict[str, Any]:
    """Figures with their uncertainty over the sessions, and what changed since the last approved one."""
    participants.find(context, code)
    known = sessions(context.store, code)
    documents = [session.document() for session in known]
    return {"participant": code, "sessions": documents, "changes": newest_changes(known)}
