"""Where a model fails, what it lacks, adding that; long work can be left alone and cancelled."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi.responses import JSONResponse

from stimrig.api.jobs.job import Job
from stimrig.api.services import models
from stimrig.api.sessions.requests import EffectsIn
from stimrig.api.web.dependencies import PROBLEM, Ctx, ModelReader, Tester, Version
from stimrig.api.web.responses.base import describe_answer, published
from stimrig.api.web.responses.models import ComparisonOut, CurvesOut, DiagnosisOut, ImprovementOut, JobOut, VersionOut

router = APIRouter(prefix="/v1", tags=["criticism"], responses=PROBLEM)
LATER: dict[int | str, dict[str, Any]] = {202: {"model": JobOut, "description": "begun; see `Location`"}}
Wait = Annotated[bool, Query(description="false: answer 202 at once, with the job's address")]


@router.get("/models/{model_id}/comparison", **describe_answer(ComparisonOut))
async def comparison(
    context: Ctx,
    _principal: ModelReader,
    row: Version,
    recording: Annotated[str | None, Query(description="another recording than the model's own")] = None,
) -> dict[str, Any]:
    """Measurement against the model's free run: the error split up, the worst places, tests of the residual."""
    return await context.analyses.comparison(row, recording)


@router.get("/models/{model_id}/curves", **describe_answer(CurvesOut))
async def curves(context: Ctx, _principal: ModelReader, row: Version) -> dict[str, Any]:
    """The measured, predicted and commanded curves and the step response, thinned to what a screen shows."""
    return await context.analyses.curves(row)


@router.get("/models/{model_id}/diagnosis", response_model=DiagnosisOut, responses=LATER)
async def diagnosis(context: Ctx, _principal: ModelReader, row: Version, wait: Wait = True) -> Any:
    """Rank the missing effects; or report that none is missing, or that the library has none for what is left."""
    if wait or await asyncio.to_thread(context.analyses.known_diagnosis, row) is not None:
        return await context.analyses.diagnosis(row)
    return later(models.begin_diagnosis(context, row))


@router.post("/models/{model_id}/effects", status_code=201, response_model=VersionOut, responses=LATER)
async def add_effects(
    context: Ctx, principal: Tester, model_id: str, body: EffectsIn, response: Response, wait: Wait = True
) -> Any:
    """Add effects: a new version, fitted anew; the old one stays as it is.

    409 where the recording does not ask for one of them, with the reason; `force`, with a reason of one's own, adds it
    all the same.
    """
    row = await asyncio.to_thread(context.versions.get, model_id)
    add = partial(context.analyses.add_effects, row, body.effects, principal.name, force=body.force, reason=body.reason)

    async def work(job: Job) -> str:
        return f"/v1/models/{(await add(on_call=job.follow)).id}"

    if not wait:
        return later(context.jobs.start("add-effects", row.id, work, (body.model_dump(), principal.name)))
    new = await add()
    response.headers["Location"] = f"/v1/models/{new.id}"
    return await asyncio.to_thread(context.versions.document, new)


@router.post("/models/{model_id}/improve", status_code=201, response_model=ImprovementOut, responses=LATER)
async def improve(context: Ctx, principal: Tester, row: Version, response: Response, wait: Wait = True) -> Any:
    """Add effects one by one while the evidence lasts; each step is a version."""

    async def work(job: Job) -> str:
        _, rows = await context.analyses.improve(row, principal.name, job.follow)
        return f"/v1/models/{rows[-1].id}"

    if not wait:
        return later(context.jobs.start("improve", row.id, work))
    job, rows = await context.analyses.improve(row, principal.name)
    response.headers["Location"] = f"/v1/models/{rows[-1].id}"
    versions = await asyncio.to_thread(lambda: [context.versions.document(new) for new in rows])
    return {**job, "versions": versions}


@router.get("/effects", response_model=None, responses={200: published("effects", "the library")})
async def effects(context: Ctx, _principal: ModelReader) -> dict[str, Any]:
    """The library of effects."""
    return await context.pool.submit("effects").result


@router.get("/jobs/{job_id}", response_model=JobOut)
def job(context: Ctx, _principal: ModelReader, job_id: str) -> dict[str, Any]:
    """Long work: how far, how long yet, and where its result lies."""
    return context.jobs.get(job_id).document()


@router.delete("/jobs/{job_id}", response_model=JobOut)
async def cancel(context: Ctx, _principal: Tester, job_id: str) -> dict[str, Any]:
    """Cancel it. What is done already stays done."""
    job = context.jobs.get(job_id)
    context.jobs.cancel(job)
    await asyncio.wait([job.result], timeout=10)
    return job.document()


def later(job: Job) -> Response:
    """202, with the job's address."""
    return JSONResponse(job.document(), status_code=202, headers={"Location": f"/v1/jobs/{job.id}"})
