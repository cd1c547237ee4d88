"""A model's page: verdict, measurement, error now and with what is missing, and the one thing to do next."""

from __future__ import annotations

import asyncio
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.charts import diagnosis_charts, model_charts
from stimrig.api.charts.figure import Figures
from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import FIT_TOGETHER, Job
from stimrig.api.models import advice, explanation, stored_model, trend
from stimrig.api.models.registry import POOR, WHAT_TO_WRITE
from stimrig.api.models.tracking import Limits, limits_words
from stimrig.api.people.auth import Scope
from stimrig.api.services import models, participants
from stimrig.api.sessions import controllers
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages import next_view
from stimrig.api.web.pages.environment import environment
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import facts, missing_parts

router = APIRouter(include_in_schema=False)
environment.globals |= {"tracking_words": limits_words, "usual_tracking": Limits().model_dump()}  # type: ignore
MOST_FINDINGS = 2
"""Failed checks in the first screen; the others stand with the parameters."""
TITLES = {"diagnosis": "Diagnosing", "add-effects": "Adding the effect", "improve": "Improving the model",
          FIT_TOGETHER: "Fitting one model to all recordings"}  # fmt: skip


@router.get("/models/{model_id}")
async def model(request: Request, context: Ctx, principal: ModelReader, row: Version, diagnose: int = -1) -> Response:
    """Show a model. `diagnose`: 1 begins a diagnosis anew, 0 begins none."""
    job = await diagnosis_job(context, row, diagnose)
    shown = await parts(context, row)
    version, document, why = shown["model"], shown["document"], shown["why"]
    findings, fit_words = advice.findings(document), advice.fit_sentence(document["fit"])
    planned = bool(why and why["experiment"])
    not_joined = await asyncio.to_thread(context.versions.why_not_joined, row) if planned else ""
    running = why is None and job is not None and job.state in ("running", "completed")
    others = [finding for finding in findings if not fit_words or finding.gate not in ("gap", "ceiling")]

    def more() -> dict[str, Any]:
        step = None  # what comes after the decision on this model; before it the verdict says what to do
        if version["decision"] is not None and principal.may(Scope.RUN_TEST):
            step = next_view.step(context, participants.find(context, row.participant), principal)
        return {
            "step": None if step is None or step.href == f"/models/{row.id}" else step,
            "changes": trend.changes_to(context.store, row),
            "has_key": version["served"] and controllers.has_key(context.auth, row.participant),
            "hdf5": not context.analyses.path(row.recording_id).endswith(".csv"),
        }

    return await asyncio.to_thread(  # its charts are drawn there, and a stop must not wait for that
        page,
        request,
        "model.html",
        advice=advice.advice(
            version["verdict"], findings, why["likely"] if why else [], why and why["kind"],
            diagnosing=running, experiment=planned and not not_joined,
        ),
        shown_findings=others[:MOST_FINDINGS],
        hidden_findings=others[MOST_FINDINGS:],
        reasons=[] if findings else version["reasons"],
        fit_words=fit_words,
        # One that has just ended is shown as running once more: the page asks after it, and then shows the diagnosis.
        job=job.document() if job and running else None,
        why_problem=job.problem if job and job.state == "failed" else None,
        ask_password=not context.people.is_confirmed(principal),
        threshold_us=stored_model.threshold_us(row),
        risks=advice.risks(document, findings) if version["verdict"] in POOR else [],
        not_joined=not_joined,
        what_to_write=WHAT_TO_WRITE,
        may_test=principal.may(Scope.RUN_TEST),
        may_approve=principal.may(Scope.APPROVE_MODEL),
        **await asyncio.to_thread(more),
        **shown,
    )  # fmt: skip


async def diagnosis_job(context: Context, row: Model, diagnose: int) -> Job | None:
    """Return the newest job that diagnoses a model, begun if nobody has; None where the diagnosis is there."""
    if await asyncio.to_thread(context.analyses.known_diagnosis, row) is not None:
        return None
    begun = [job for job in context.jobs.all.values() if (job.kind, job.subject) == ("diagnosis", row.id)]
    if diagnose == 1 or (not begun and diagnose != 0):
        begun.append(models.begin_diagnosis(context, row))
        await asyncio.sleep(0.05)
    return begun[-1] if begun else None


async def parts(context: Context, row: Model) -> dict[str, Any]:
    """Collect what a model's page, its charts and its report show alike."""
    measured = await measurement(context, row)

    def read() -> dict[str, Any]:
        document, comparison = stored_model.read(row), measured["comparison"]
        diagnosis = context.analyses.known_diagnosis(row)
        why = explanation.view(diagnosis, comparison) if diagnosis else None
        lineage = [context.versions.document(version) for version in context.versions.lineage(row)]
        rows = explanation.versions(lineage, row.id)
        place = next(number for number, version in enumerate(rows) if version["current"])
        later, earlier = rows[place + 1 :], rows[place - 1] if place else None
        segments, signatures = (measured["curves"] or {}).get("segments") or [], (diagnosis or {}).get("signatures")
        figures = model_charts.model_figures(document, measured["curves"], comparison)
        figures |= diagnosis_charts.diagnosis_figures(comparison, segments, why, signatures or {}, rows)
        return {
            "model": rows[place],
            "document": document,
            "problem": measured["problem"],
            **missing_parts(why, comparison),
            "versions": rows,
            "earlier": earlier if earlier and earlier["id"] == row.parent_id else None,
            "added": {name: each["id"] for each in later for name in (each["added_effect"] or "").split(",")},
            **facts(document),
            "warnings": context.runner.lifecycle.warnings(row.recording_id),
            "now_utc": context.clock.utc(),
            "figures": Figures(figures, f"/models/{row.id}/figures"),
        }

    return await asyncio.to_thread(read)


async def measurement(context: Context, row: Model) -> dict[str, Any]:
    """Return `curves` and `comparison`, or the `problem` that keeps them from being drawn."""
    try:
        curves, comparison = await asyncio.gather(context.analyses.curves(row), context.analyses.comparison(row))
    except ApiError as error:
        return {"curves": None, "comparison": None, "problem": error}
    return {"curves": curves, "comparison": comparison, "problem": None}


@router.get("/jobs/{job_id}")
async def job(request: Request, context: Ctx, _principal: ModelReader, job_id: str) -> Response:
    """Show how far a job is; lead on to its result once it is done."""
    job = context.jobs.get(job_id)
    if job.result_url is not None:
        return RedirectResponse(job.result_url.removeprefix("/v1").removesuffix("/diagnosis"), 303)
    problem = job.problem if job.state == "failed" else None
    title, status = (problem.title, problem.status) if problem else (TITLES[job.kind], 200)
    return page(request, "job.html", status, job=job.document(), problem=problem, title=title)
