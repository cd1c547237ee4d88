"""A model: beside its measurement, why it fails, and what can be done about it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts.drawing import Figures
from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import FIT_TOGETHER, Job
from stimrig.api.models import advice, carried_structure, explanation, stored_model
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.sessions import controllers
from stimrig.api.sessions.requests import EffectsIn, TestIn
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Approver, Context, Ctx, ModelReader, Tester, Version
from stimrig.api.web.pages import next_view, starting, typed
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import missing_parts
from stimrig.api.web.pages.typed import Text
from stimrig.api.web.routes import criticism, participants

router = APIRouter(include_in_schema=False)
TITLES = {"diagnosis": "Diagnosing", "add-effects": "Adding the effect", "improve": "Improving the model",
          FIT_TOGETHER: "Fitting one model to all recordings"}  # fmt: skip


@router.get("/models/{model_id}")
async def model(request: Request, context: Ctx, who: ModelReader, row: Version, diagnose: int = -1) -> Response:
    """A model beside its measurement, and why it fails. `diagnose`: 1 begins a diagnosis anew, 0 begins none."""
    document = stored_model.read(row)
    measured = await measurement(context, row)
    diagnosis = await looked_at(context, row, who.name, diagnose)
    found = advice.findings(document)
    shown = await asyncio.to_thread(gather, context, row, measured, diagnosis)
    version = await asyncio.to_thread(context.versions.document, row)
    why = shown["why"]
    return page(
        request,
        "model.html",
        model=version,
        findings=found,
        advice=advice.advice(
            version["verdict"], found, why["likely"] if why else [], why and why["kind"], shown["job"] is not None
        ),
        fit_words=advice.fit_sentence(document.get("fit") or {}),
        step=await next_step_of(context, row, version, who),
        changes=await asyncio.to_thread(context.trend.changes_to, row),
        ask_password=not await context.people.is_confirmed(who.session_hash),
        **await facts(context, row, document),
        threshold_us=stored_model.threshold_us(row),
        has_key=version["served"] and await asyncio.to_thread(controllers.has_key, context.auth, row.participant),
        problem=measured["problem"],
        reasons=[] if found else version["reasons"],
        hdf5=not (await asyncio.to_thread(context.analyses.path, row.recording_id)).endswith(".csv"),
        may_test=who.may(Scope.RUN_TEST),
        may_approve=who.may(Scope.APPROVE_MODEL),
        **shown,
    )


async def figures_of(context: Context, row: Model) -> Figures:
    """The charts of a model's page, with what its diagnosis adds once it is there."""
    measured = await measurement(context, row)

    def draw() -> Figures:
        found = context.analyses.known_diagnosis(row)
        view = explanation.view(found, measured["comparison"]) if found else None
        return _figures(row, measured, found, view, versions_of(context, row))

    return await asyncio.to_thread(draw)


async def facts(context: Context, row: Model, document: dict[str, Any]) -> dict[str, Any]:
    """What a model's page and its report show alike."""
    return {
        "document": document,
        "held": explanation.held_free(document),
        "recruitment": stored_model.recruitment(document),
        "dynamics": stored_model.dynamics(document),
        "repetition": stored_model.repetition(document),
        "validity": stored_model.validity(document),
        "warnings": await asyncio.to_thread(context.runner.lifecycle.warnings, row.recording_id),
        "now_utc": context.clock.utc(),
    }


def draw_own(document: dict[str, Any], measured: dict[str, Any]) -> dict[str, Any]:
    """The model's own figures; the first one low enough for the first screen."""
    figures = model_charts.model_figures(document, measured["curves"], measured["comparison"])
    held = diagnosis_charts.free_effects(explanation.held_free(document))
    return figures | held | joint_charts.joint_figures(document)


async def next_step_of(context: Context, row: Model, version: dict[str, Any], who: Principal) -> next_view.Step | None:
    """What comes after the decision on this model; before it the verdict says what to do."""
    if version["decision"] is None or not who.may(Scope.RUN_TEST):
        return None
    participant = await asyncio.to_thread(participants.find, context, row.participant)
    step = await asyncio.to_thread(next_view.step, context, participant, who)
    return None if step.href == f"/models/{row.id}" else step


async def measurement(context: Context, row: Model) -> dict[str, Any]:
    """Curves and comparison, or the problem that keeps them from being drawn."""
    found: dict[str, Any] = {"curves": None, "comparison": None, "problem": None}
    try:
        found["curves"], found["comparison"] = await asyncio.gather(
            context.analyses.curves(row), context.analyses.comparison(row)
        )
    except ApiError as error:
        found["problem"] = error
    return found


async def looked_at(context: Context, row: Model, by: str, diagnose: int) -> dict[str, Any]:
    """The diagnosis if it is there; else the job that makes it, begun if nobody has."""
    known = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    if known is not None:
        return {"found": known, "job": None}
    jobs = [job for job in context.jobs.all.values() if (job.kind, job.subject) == ("diagnosis", row.id)]
    newest = jobs[-1] if jobs else None
    if diagnose == 1 or (newest is None and diagnose != 0):
        newest = criticism.begin_diagnosis(context, row, by)
        await asyncio.sleep(0.05)
    if newest is not None and newest.state == "completed":  # it was done between the two looks
        known = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    return {"found": known, "job": newest}


def gather(context: Context, row: Model, measured: dict[str, Any], diagnosis: dict[str, Any]) -> dict[str, Any]:
    """What is missing, and where the error sits."""
    found, comparison, job = diagnosis["found"], measured["comparison"], diagnosis["job"]
    view = explanation.view(found, comparison) if found else None
    lineage = context.versions.lineage(row)
    rows = versions_of(context, row, lineage)
    later = rows[[each["id"] for each in rows].index(row.id) + 1 :]
    return {
        **missing_parts(view, comparison),
        # One that has just ended is shown as running once more: the page asks after it, and then shows what it found.
        "job": job.document() if job and not found and job.state in ("running", "completed") else None,
        "why_problem": job.problem if job and job.state == "failed" else None,
        "versions": rows,
        "undone": next((each for each in later[:1] if each["undone"]), None),
        "decided": explanation.decided(context.analyses.experiment_before(lineage[0]), found, row.effects)
        if found
        else "",
        "added": {effect: each["id"] for each in later for effect in (each["added_effect"] or "").split(",")},
        "carried": carried_structure.carried_context(context.versions, row, found),
        "figures": _figures(row, measured, found, view, rows),
    }


def _figures(
    row: Model, measured: dict[str, Any], found: dict[str, Any] | None, view: dict[str, Any] | None,
    rows: list[dict[str, Any]],
) -> Figures:  # fmt: skip
    segments = (measured["curves"] or {}).get("segments") or []
    signatures = (found or {}).get("signatures") or {}
    return Figures(
        draw_own(stored_model.read(row), measured)
        | diagnosis_charts.diagnosis_figures(measured["comparison"], segments, view, signatures, rows),
        f"/models/{row.id}/figures/{{}}",
    )


def versions_of(context: Context, row: Model, lineage: Sequence[Model] = ()) -> list[dict[str, Any]]:
    """The versions of the model's recording, as its page and its report show them; `lineage`: where it is known."""
    known = lineage or context.versions.lineage(row)
    return explanation.versions([context.versions.document(version) for version in known], row.id)


@router.post("/models/{model_id}/diagnosis/cancel")
async def cancel_diagnosis(context: Ctx, _who: Tester, model_id: str) -> Response:
    """Stop diagnosing; the page then offers to begin anew."""
    for job in list(context.jobs.all.values()):
        if (job.kind, job.subject) == ("diagnosis", model_id):
            context.jobs.cancel(job)
    return RedirectResponse(f"/models/{model_id}?diagnose=0", 303)


@router.post("/models/{model_id}/effects")
async def add_effect(
    context: Ctx, who: Tester, row: Version, effect: Text = "", force: Text = "", reason: Text = ""
) -> Response:
    """Add one effect."""
    body = typed.checked(EffectsIn, effects=[effect], reason=reason[:500], force=bool(force))
    return await to_job(criticism.begin_adding(context, row, body, who.name))


@router.post("/models/{model_id}/improve")
async def improve(context: Ctx, who: Tester, row: Version) -> Response:
    """Add what is missing, one by one."""
    return await to_job(criticism.begin_improving(context, row, who.name))


@router.post("/models/{model_id}/undo")
async def undo(context: Ctx, who: Approver, model_id: str) -> Response:
    """Back to the version before."""
    parent, _version = await asyncio.to_thread(context.versions.undo, model_id, who.name, "")
    return RedirectResponse(f"/models/{parent.id}#versions", 303)


@router.post("/models/{model_id}/experiment")
async def run_experiment(context: Ctx, who: Tester, row: Version) -> Response:
    """To the question before the diagnosis' next experiment; its recording is joined to this model's."""
    found = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    experiment = (found or {}).get("experiment")
    if not experiment:
        detail = "The diagnosis of this recording names none: no effects need to be told apart."
        raise ApiError(409, "no-experiment", "There is no next experiment", detail)
    asked = {key: experiment[key] for key in ("segments", "pulse_rate_hz") if key in experiment}
    body = TestIn.model_validate({"participant": row.participant, "kind": "next-experiment", "joins": row.id, **asked})
    return RedirectResponse(await starting.ask(context, who, body, back=f"/models/{row.id}#experiment"), 303)


# ---- long work ----------------------------------------------------------------------------------------------


async def to_job(job: Job) -> Response:
    """To the result where it is there at once, else to the page that waits for it."""
    await asyncio.wait([job.result], timeout=0.3)
    return RedirectResponse(result_page(job) or f"/jobs/{job.id}", 303)


def result_page(job: Job) -> str | None:
    """The page on which the result is seen."""
    if job.result_url is None:
        return None
    page_url = job.result_url.removeprefix("/v1").removesuffix("/diagnosis")
    return f"{page_url}/story" if job.kind == "improve" else page_url


@router.get("/jobs/now/{job_id}")
async def job_now(context: Ctx, _who: ModelReader, job_id: str) -> dict[str, Any]:
    """How far long work is: what a page that waits asks for again and again."""
    found = context.jobs.get(job_id).document()
    return {key: found[key] for key in ("progress", "time_left_s", "done")} | {"text": found["text"]}


@router.get("/jobs/{job_id}")
async def job(request: Request, context: Ctx, _who: ModelReader, job_id: str) -> Response:
    """Long work: how far it is; on to its result once it is done."""
    job = context.jobs.get(job_id)
    target = result_page(job)
    if target:
        return RedirectResponse(target, 303)
    title = job.problem.title if job.state == "failed" and job.problem else TITLES[job.kind]
    status = job.problem.status if job.problem and job.state == "failed" else 200
    return page(request, "job.html", status, job=job.document(), problem=job.problem, title=title)


@router.post("/jobs/{job_id}/cancel")
async def cancel(context: Ctx, _who: Tester, job_id: str) -> Response:
    """Cancel it."""
    job = context.jobs.get(job_id)
    context.jobs.cancel(job)
    if job.kind == FIT_TOGETHER:
        return RedirectResponse(f"/participants/{job.subject}/joint", 303)
    return RedirectResponse(f"/models/{job.subject}#why", 303)
