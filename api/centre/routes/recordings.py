"""Recordings: a list for a cohort, and each one's file."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import Response

from stimrig.api.centre import clean, directory, handed_out
from stimrig.api.centre.context import Ctx
from stimrig.api.centre.directory import Cohort
from stimrig.api.centre.responses import RecordingsOut
from stimrig.api.centre.routes.participants import the_rig
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.store.centre_tables import CentreRecording
from stimrig.api.web.dependencies import PROBLEM, ModelReader
from stimrig.api.web.responses.base import answers

router = APIRouter(prefix="/v1", tags=["recordings"], responses=PROBLEM)
HDF5 = "application/x-hdf5"


@router.get("/recordings", **answers(RecordingsOut))
def recordings(
    context: Ctx, _who: ModelReader, participant: str | None = None, rig: str | None = None,
    from_: Annotated[str | None, Query(alias="from", description="day or time (UTC), as 2026-11-23")] = None,
    to: Annotated[str | None, Query(description="the same; a day counts to its end")] = None,
    after: str | None = None, limit: Annotated[int, Query(ge=1, le=1000)] = 500,
) -> dict[str, Any]:  # fmt: skip
    """Recordings in order of time; `after` of an answer leads to the next page."""
    if participant and clean.code(participant) is None:
        raise ApiError(422, "invalid-input", "The request is not valid", "participant: give a code")
    begin, end = moment("from", from_, 0), moment("to", to, 1)
    asked = Cohort(participant or None, the_rig(context, rig).id if rig else None, begin, end, after or None)
    found, last = directory.recordings(context.store, asked, limit)
    return {"recordings": found, "after": last}


def moment(name: str, given: str | None, days: int) -> str | None:
    """The beginning or the end of what is asked for, as a label in UTC. Raises ApiError (422)."""
    if not given:
        return None
    if clean.a_day(given) is not None and given < "9999-12":
        return clean.days_later(given, days)
    if clean.label(given, "") == given:
        return given
    detail = f"{name}: give a day as 2026-11-23, or a time as 2026-11-23T08:00:00Z"
    raise ApiError(422, "invalid-input", "The request is not valid", detail)


@router.get("/recordings/{recording_id}", response_class=Response, responses={200: {"content": {HDF5: {}}}})
async def recording(context: Ctx, _who: ModelReader, recording_id: int) -> Response:
    """A recording, HDF5; refused where it differs from its hash."""
    known = 0 < recording_id < 2**53
    row = await asyncio.to_thread(context.store.get, CentreRecording, recording_id) if known else None
    if row is None:
        raise NotFoundError("recording", str(recording_id)[:40], "GET /v1/recordings lists them.")
    return await handed_out.file(context, row.file, f"{row.participant}-{row.recording_id}.h5", HDF5)
