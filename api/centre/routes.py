"""The centre's REST routes for people and programs: operation, participants, recordings, rigs, warnings."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import PlainTextResponse, Response
from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from pydantic import BaseModel, ConfigDict, StringConstraints
from sqlalchemy import text

from stimrig.api.centre import clean, directory, warnings
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.directory import Cohort, asked, page_key, the_rig
from stimrig.api.centre.downloads import hand_out
from stimrig.api.centre.responses import (
    CentreHealthOut,
    ParticipantsOut,
    RecordingsOut,
    RigKeyOut,
    RigOut,
    SessionsOut,
    WarningOut,
)
from stimrig.api.clock import unix_of
from stimrig.api.errors import invalid, require_found
from stimrig.api.store.centre_tables import CentreModel, CentreRecording
from stimrig.api.web.dependencies import PROBLEM, Administrator, ModelReader
from stimrig.api.web.monitoring import Figures
from stimrig.api.web.responses.base import describe_answer

operation = APIRouter(tags=["operation"])
v1 = APIRouter(prefix="/v1", responses=PROBLEM)
Day = Annotated[str | None, Query(description="a day, as 2026-11-23")]
HDF5 = "application/x-hdf5"
SECRET = ("id", "key_hash", "key_prefix", "audit_hash")


@operation.get("/health", **describe_answer(CentreHealthOut))
def health(context: Ctx) -> dict[str, Any]:
    """`ok` where database and bucket answer; `degraded` where the bucket does not. Holds nothing of any participant."""
    with context.store.read() as session:
        session.execute(text("SELECT 1"))
    trouble = context.bucket.trouble
    return {
        "status": "degraded" if trouble else "ok", "database": "ok", "files": "failed" if trouble else "ok",
        "uptime_s": round(time.monotonic() - context.started_s, 1),
    }  # fmt: skip


@operation.get("/metrics", response_class=PlainTextResponse)
def metrics(context: Ctx) -> Response:
    """Figures in Prometheus' text format."""
    return Response(generate_latest(Figures(lambda: figures(context))), media_type=CONTENT_TYPE_PLAIN_0_0_4)


def figures(context: Context) -> Iterator[Metric]:
    """The centre's figures, one family after the other."""
    rigs = [row for row in context.rigs.all() if row.revoked_utc is None]
    now_s = context.clock.unix_s()
    unseen = GaugeMetricFamily("stimrig_centre_rig_unseen_seconds", "Since the rig was seen", labels=["rig"])
    waiting = GaugeMetricFamily("stimrig_centre_rig_waiting_files", "Files that wait there", labels=["rig"])
    for row in rigs:
        unseen.add_metric([row.name], now_s - unix_of(row.seen_utc) if row.seen_utc else -1.0)
        waiting.add_metric([row.name], row.waiting_files or 0)
    yield from (unseen, waiting)
    for name, words, value in (
        ("stimrig_centre_up_seconds", "Time since start", time.monotonic() - context.started_s),
        ("stimrig_centre_rigs", "Rigs that have a key", len(rigs)),
        ("stimrig_centre_recordings", "Recordings that rigs told of", sum(row.recordings for row in rigs)),
        ("stimrig_centre_warnings", "Warnings that nobody has acknowledged", warnings.open_count(context.store)),
        ("stimrig_centre_bucket_ok", "1 where the bucket can be used", float(context.bucket.trouble is None)),
        (
            "stimrig_centre_free_disk_bytes",
            "Free where files come in",
            shutil.disk_usage(context.settings.data_dir).free,
        ),
    ):
        yield GaugeMetricFamily(name, words, value)


@v1.get("/participants", tags=["participants"], **describe_answer(ParticipantsOut))
def participants(
    context: Ctx, _who: ModelReader, q: Annotated[str, Query(max_length=32, description="the code begins so")] = "",
    rig: str | None = None, from_: Annotated[str | None, Query(alias="from", description="a day")] = None,
    to: Day = None, effect: str | None = None, verdict: str | None = None, after: str | None = None,
    limit: Annotated[int, Query(ge=1, le=500)] = 100,
) -> dict[str, Any]:  # fmt: skip
    """Participants by code; of a session between the days with the verdict, and with a model that holds the effect."""
    search = asked(context.store, q, rig, from_, to, effect, verdict, after)
    if search.q and not clean.CODE.fullmatch(search.q):
        return {"participants": [], "after": None}
    found, last = directory.participants(context.store, search, limit)
    return {"participants": found, "after": last}


@v1.get("/participants/{code}/sessions", tags=["participants"], **describe_answer(SessionsOut))
def sessions(
    context: Ctx, _who: ModelReader, code: str, before: str | None = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> dict[str, Any]:  # fmt: skip
    """A participant's sessions over all rigs, newest first."""
    directory.require(context.store, code[:40])
    found, more = directory.sessions(context.store, code, page_key(before), limit)
    plain = ("made_tests", "made_recordings", "models", "decisions", "rig_id")
    listed = [{name: value for name, value in one.items() if name not in plain} for one in found]
    return {"participant": code, "sessions": listed, "before": f"{more[0]}~{more[1]}" if more else None}


@v1.get("/rigs/{rig}/models/{model_id}/file", tags=["participants"], response_class=Response)
async def model_file(context: Ctx, _who: ModelReader, rig: str, model_id: str) -> Response:
    """MODEL.json, as the rig made it; refused where it differs from its hash."""
    key = (await asyncio.to_thread(the_rig, context.store, rig)).id, model_id[:64]
    row = require_found(await asyncio.to_thread(context.store.get, CentreModel, key), "model", model_id[:64])
    return await hand_out(context, row.file, f"{row.participant}-{row.id}.json", "application/json")


@v1.get("/recordings", tags=["recordings"], **describe_answer(RecordingsOut))
def recordings(
    context: Ctx, _who: ModelReader, participant: str | None = None, rig: str | None = None,
    from_: Annotated[str | None, Query(alias="from", description="day or time (UTC), as 2026-11-23")] = None,
    to: Annotated[str | None, Query(description="the same; a day counts to its end")] = None,
    after: str | None = None, limit: Annotated[int, Query(ge=1, le=1000)] = 500,
) -> dict[str, Any]:  # fmt: skip
    """Recordings in order of time; `after` of an answer leads to the next page."""
    if participant and clean.code(participant) is None:
        raise invalid("participant: give a code")
    begin, end = moment("from", from_, 0), moment("to", to, 1)
    asked = Cohort(participant or None, the_rig(context.store, rig).id if rig else None, begin, end, after or None)
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
    raise invalid(f"{name}: give a day as 2026-11-23, or a time as 2026-11-23T08:00:00Z")


@v1.get(
    "/recordings/{recording_id}", tags=["recordings"], response_class=Response, responses={200: {"content": {HDF5: {}}}}
)
async def recording(context: Ctx, _who: ModelReader, recording_id: int) -> Response:
    """A recording, HDF5; refused where it differs from its hash."""
    known = 0 < recording_id < 2**53
    row = await asyncio.to_thread(context.store.get, CentreRecording, recording_id) if known else None
    row = require_found(row, "recording", str(recording_id)[:40], "GET /v1/recordings lists them.")
    return await hand_out(context, row.file, f"{row.participant}-{row.recording_id}.h5", HDF5)


class RigIn(BaseModel):
    """A new rig."""

    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, StringConstraints(min_length=1, max_length=60)]


@v1.get("/rigs", tags=["rigs"], **describe_answer(list[RigOut]))
def list_rigs(context: Ctx, _who: ModelReader) -> list[dict[str, Any]]:
    """All rigs, by name, without what is nobody's business."""
    rows = [row.as_dict() for row in context.rigs.all()]
    return [{name: value for name, value in row.items() if name not in SECRET} for row in rows]


@v1.post("/rigs", tags=["rigs"], status_code=201, **describe_answer(RigKeyOut, 201, "added"))
def add_rig(context: Ctx, who: Administrator, body: RigIn) -> dict[str, Any]:
    """A new rig, or a new key for one whose key was revoked. The key's text is shown this once."""
    return {"name": body.name, "key": context.rigs.add(body.name, who.name)}


@v1.delete("/rigs/{name}", tags=["rigs"], status_code=204)
def revoke_rig(context: Ctx, who: Administrator, name: str) -> None:
    """Its key opens nothing any more; what it pushed stays."""
    context.rigs.revoke(name, who.name)


@v1.get("/warnings", tags=["rigs"], **describe_answer(list[WarningOut]))
def list_warnings(
    context: Ctx, _who: ModelReader, acknowledged: bool = False, before: Annotated[int | None, Query(ge=1)] = None
) -> list[dict[str, Any]]:
    """Newest first: those that wait to be acknowledged, or those that were; `before`: an id, for the next page."""
    rows = warnings.listed(context.store, acknowledged, before if before is None else min(before, 2**31 - 1))
    return [{name: value for name, value in row.items() if name != "rig_id"} for row in rows]


@v1.post("/warnings/{warning_id}/acknowledge", tags=["rigs"], status_code=204)
def acknowledge(context: Ctx, who: Administrator, warning_id: int) -> None:
    """A person has seen it."""
    warnings.acknowledge(context.store, context.clock, warning_id, who.name)
