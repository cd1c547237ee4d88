"""Recordings: the raw HDF5 as it was sealed, and recordings of other tools taken in."""

from __future__ import annotations

import asyncio
import secrets
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from stimrig.api.services import participants, recordings
from stimrig.api.web.dependencies import PROBLEM, Confirm, Ctx, ModelReader, ParticipantVersion, Tester
from stimrig.api.web.leaving import while_connected
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.rig import UploadOut

router = APIRouter(prefix="/v1", tags=["recordings"], responses=PROBLEM)

BINARY = {"schema": {"type": "string", "format": "binary"}}
UPLOAD = {"requestBody": {"required": True, "content": {"application/octet-stream": BINARY}}}
CSV = {"description": "one row a sample", "content": {"text/csv": {"schema": {"type": "string"}}}}
KINDS = {
    ".h5": "application/x-hdf5", ".csv": "text/csv", ".mat": "application/x-matlab-data",
    ".parquet": "application/vnd.apache.parquet",
}  # fmt: skip
RAW_KINDS = ("application/octet-stream", *KINDS.values())
RAW = {
    "description": "the file as it was sealed or sent in; `X-Content-SHA256` is its checksum",
    "content": dict.fromkeys(RAW_KINDS, BINARY),  # the first one for clients that know no other kind of bytes
}
GONE = problem("the file is not in its place any more")
MOST_COLUMNS = 8


@router.get("/recordings/{recording_id}", response_class=FileResponse, responses={200: RAW, 410: GONE})
def recording(context: Ctx, _principal: ModelReader, recording_id: str) -> FileResponse:
    """The raw recording."""
    row, path = recordings.find(context, recording_id)
    kind = KINDS.get(path.suffix, "application/x-hdf5")
    return FileResponse(path, media_type=kind, filename=path.name, headers={"X-Content-SHA256": row.file_sha256})


@router.get("/recordings/{recording_id}/csv", response_class=FileResponse, responses={200: CSV, 410: GONE})
async def recording_csv(context: Ctx, _principal: ModelReader, recording_id: str, request: Request) -> FileResponse:
    """The recording as CSV, one row a sample: what other tools read, and what can be uploaded again."""
    _row, source = await asyncio.to_thread(recordings.find, context, recording_id)
    name = f"{recording_id}.csv"
    out = context.settings.exports_dir / f"{secrets.token_hex(8)}.csv"
    gone = BackgroundTask(out.unlink, missing_ok=True)
    try:
        await while_connected(request, context.analyses.run("plain_csv", data=str(source), out=str(out)))
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return FileResponse(out, media_type="text/csv", filename=name, background=gone)


@router.post(
    "/participants/{code}/recordings",
    status_code=201,
    openapi_extra=UPLOAD,
    **describe_answer(UploadOut, 201, "taken in"),
)
async def upload(
    context: Ctx,
    principal: Tester,
    code: str,
    tags: ParticipantVersion,
    request: Request,
    response: Response,
    columns: Annotated[list[str], Query(alias="map", max_length=MOST_COLUMNS)] = [],  # noqa: B006
    of: Annotated[str, Query(description="whose recording it is, where the participant's it is not")] = "",
    confirm: Confirm = "",
) -> dict[str, Any]:
    """Upload a recording of another tool (CSV, MAT, Parquet or HDF5 as the body) and identify a model from it.

    `map` says what a column is called there and its unit, once for each column: `map=torque_nm=Drehmoment:Nm`.
    What was assumed is told in `warnings`. A recording that says that it is another participant's, or whose samples are
    stored as one of theirs in any format, is refused, but with `of`, by who may approve models; the audit trail keeps
    both codes. The work is given up when the client leaves.
    """
    await asyncio.to_thread(participants.find, context, code)
    whole = await recordings.spool(context, request.stream(), ".csv" if columns else "")
    taking = recordings.take_in(context, code, whole, principal, tags, columns, of or confirm)
    row, model, warnings = await while_connected(request, taking)
    response.headers["Location"] = f"/v1/recordings/{row.id}"
    version = await asyncio.to_thread(context.versions.document, model)
    return {"recording_id": row.id, "model": version, "warnings": warnings}
