"""What rigs ask (decision 0013): with the key of a rig, which opens nothing else."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Security
from fastapi.security import HTTPBearer

from stimrig.api.centre.context import Ctx
from stimrig.api.centre.ingest import read
from stimrig.api.centre.spool import MOST_LISTED, MOST_PIECE_BYTES
from stimrig.api.errors import ApiError
from stimrig.api.outbox.messages import BatchIn, HeadsOut, HelloIn, HelloOut, LackingFilesOut, PieceOut, PlaceOut
from stimrig.api.store.centre_tables import CentreRig
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import describe_answer

BYTES = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
KEY = HTTPBearer(scheme_name="rig", description="a rig's key", auto_error=False)
PROBLEMS: dict[int | str, dict[str, Any]] = {
    400: problem("no sound JSON"), 401: problem("the key is unknown or revoked"), 409: problem("go on elsewhere"),
    413: problem("too long"), 422: problem("it does not hold, or differs from its hash"),
    503: problem("too many pieces of this rig at once"), 507: problem("the bucket is full or gone"),
}  # fmt: skip
router = APIRouter(prefix="/v1/rig", tags=["rigs push"], responses=PROBLEMS)


async def the_rig(request: Request, _key: Annotated[object, Security(KEY)]) -> CentreRig:
    """A dependency: the rig whose key came."""
    return await asyncio.to_thread(request.app.state.context.rigs.identify, request)


Rig = Annotated[CentreRig, Security(the_rig)]


def taken(model: Any) -> dict[str, Any]:
    """The body in the OpenAPI document: it is read in a thread, and only after the key."""
    schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
    for name, part in schema.pop("$defs", {}).items():
        for field in schema["properties"].values():
            if field.get("items", {}).get("$ref", "").endswith(f"/{name}"):
                field["items"] = part
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


@router.post("/hello", **describe_answer(HelloOut), openapi_extra=taken(HelloIn))
async def hello(request: Request, context: Ctx, rig: Rig) -> dict[str, Any]:
    """How the rig is; the newest item that the centre has of its chain."""
    raw = await request.body()
    return await asyncio.to_thread(lambda: context.ingest.hello(rig, read(HelloIn, raw)))


@router.post("/items", **describe_answer(PlaceOut), openapi_extra=taken(BatchIn))
async def items(request: Request, context: Ctx, rig: Rig) -> dict[str, Any]:
    """A batch: all of it is taken, or nothing. What is known already is skipped."""
    raw = await request.body()
    place = await asyncio.to_thread(lambda: context.ingest.take(rig, read(BatchIn, raw)))
    return {"seq": place.seq, "hash": place.hash}


@router.get("/files", **describe_answer(LackingFilesOut))
def files(context: Ctx, rig: Rig, limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100) -> dict[str, Any]:
    """Files that items of this rig name and the centre lacks, oldest first."""
    return {"files": context.spool.lacking(rig, limit)}


@router.get("/heads", **describe_answer(HeadsOut))
def heads(
    context: Ctx, rig: Rig, chain: Annotated[str, Query(max_length=32)] = "",
    item: Annotated[int, Query(ge=0, le=2**53)] = 0,
) -> dict[str, Any]:  # fmt: skip
    """Heads of the rig's audit trail, countersigned (Ed25519), after that of an item; at most 500."""
    return {"heads": context.heads.after(rig, chain, item)}


@router.put("/files/{sha256}", **describe_answer(PieceOut), openapi_extra={"requestBody": {"content": BYTES}})
async def put(
    request: Request, context: Ctx, rig: Rig, sha256: Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")],
    offset: Annotated[int, Query(ge=0, le=2**53)] = 0,
) -> dict[str, Any]:  # fmt: skip
    """A piece of a file, from `offset` on."""
    with context.one_more_of(rig.id):
        data = await request.body()
        if len(data) > MOST_PIECE_BYTES:
            raise ApiError(413, "content-too-large", "Too long", f"At most {MOST_PIECE_BYTES} bytes are taken at once.")
        async with context.puts:
            return await context.with_bucket(context.spool.put, rig, sha256, offset, data)
