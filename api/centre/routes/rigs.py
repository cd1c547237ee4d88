"""Rigs and warnings."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, StringConstraints

from stimrig.api.centre import warnings
from stimrig.api.centre.context import Ctx
from stimrig.api.centre.responses import RigKeyOut, RigOut, WarningOut
from stimrig.api.store.centre_tables import CentreRig
from stimrig.api.web.dependencies import PROBLEM, Administrator, ModelReader
from stimrig.api.web.responses.base import answers

router = APIRouter(prefix="/v1", tags=["rigs"], responses=PROBLEM)
SECRET = ("id", "key_hash", "key_prefix", "audit_hash")


class RigIn(BaseModel):
    """A new rig."""

    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, StringConstraints(min_length=1, max_length=60)]


def shown(row: CentreRig) -> dict[str, Any]:
    """A rig, without what is nobody's business."""
    return {name: value for name, value in row.as_dict().items() if name not in SECRET}


@router.get("/rigs", **answers(list[RigOut]))
def list_rigs(context: Ctx, _who: ModelReader) -> list[dict[str, Any]]:
    """All rigs, by name."""
    return [shown(row) for row in context.rigs.all()]


@router.post("/rigs", status_code=201, **answers(RigKeyOut, 201, "added"))
def add_rig(context: Ctx, who: Administrator, body: RigIn) -> dict[str, Any]:
    """A new rig, or a new key for one whose key was revoked. The key's text is shown this once."""
    return {"name": body.name, "key": context.rigs.add(body.name, who.name)}


@router.delete("/rigs/{name}", status_code=204)
def revoke_rig(context: Ctx, who: Administrator, name: str) -> None:
    """Its key opens nothing any more; what it pushed stays."""
    context.rigs.revoke(name, who.name)


@router.get("/warnings", **answers(list[WarningOut]))
def list_warnings(
    context: Ctx, _who: ModelReader, acknowledged: bool = False, before: Annotated[int | None, Query(ge=1)] = None
) -> list[dict[str, Any]]:
    """Newest first: those that wait to be acknowledged, or those that were; `before`: an id, for the next page."""
    rows = warnings.listed(context.store, acknowledged, before if before is None else min(before, 2**31 - 1))
    return [{name: value for name, value in row.items() if name != "rig_id"} for row in rows]


@router.post("/warnings/{warning_id}/acknowledge", status_code=204)
def acknowledge(context: Ctx, who: Administrator, warning_id: int) -> None:
    """A person has seen it."""
    warnings.acknowledge(context.store, context.clock, warning_id, who.name)
