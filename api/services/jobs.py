"""Long work that a person looks on at, each as a job."""

from __future__ import annotations

from stimrig.api.jobs.job import Job
from stimrig.api.services.context import Context
from stimrig.api.sessions.requests import EffectsIn
from stimrig.api.store.tables import Model


def begin_diagnosis(context: Context, model: Model) -> Job:
    """Diagnose while the person looks on."""

    async def work(job: Job) -> str:
        await context.analyses.diagnosis(model, job.follow)
        return f"/v1/models/{model.id}/diagnosis"

    return context.jobs.start("diagnosis", model.id, work)


def begin_adding(context: Context, model: Model, body: EffectsIn, by: str) -> Job:
    """Add effects while the person looks on."""

    async def work(job: Job) -> str:
        new = await context.analyses.add_effects(
            model, body.effects, by, force=body.force, reason=body.reason, on_call=job.follow
        )
        return f"/v1/models/{new.id}"

    return context.jobs.start("add-effects", model.id, work, (body.model_dump(), by))


def begin_improving(context: Context, model: Model, by: str) -> Job:
    """Improve while the person looks on."""

    async def work(job: Job) -> str:
        _, rows = await context.analyses.improve(model, by, job.follow)
        return f"/v1/models/{rows[-1].id}"

    return context.jobs.start("improve", model.id, work)
