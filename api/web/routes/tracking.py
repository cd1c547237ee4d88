"""The trials of a controller under the approval that holds: what each said of the muscle."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from api.web.dependencies import PROBLEM, Ctx, ModelReader
from api.web.responses.base import answers
from api.web.responses.tracking import TrackingOut
from api.web.routes import models, participants

router = APIRouter(prefix="/v1/participants/{code}", tags=["models"], responses=PROBLEM)


@router.get("/tracking", **answers(TrackingOut))
def tracking(context: Ctx, _who: ModelReader, code: str) -> dict[str, Any]:
    """The trials since the approval that holds, oldest first; 404 where no model is approved today."""
    found = context.tracked.document(code)
    if found is None:
        participants.find(context, code)
        raise models.none_approved(code)
    return found
