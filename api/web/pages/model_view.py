"""A model's page: verdict, measurement, error now and with what is missing, and the one thing to do next."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.charts.drawing import Figures
from stimrig.api.errors import ApiError
from stimrig.api.jobs.job import FIT_TOGETHER, Job
from stimrig.api.models import advice, carried_structure, explanation, stored_model
from stimrig.api.people.auth import Principal, Scope
from stimrig.api.services import jobs, participants
from stimrig.api.sessions import controllers
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages import next_view
from stimrig.api.web.pages.render import page
from stimrig.api.web.pages.report_file import missing_parts

router = APIRouter(include_in_schema=False)
OVERVIEW_PX, CURVE_PX = 320.0, 190.0
"""Heights of the measurement and of the recruitment curve in the first screen."""
MOST_FINDINGS = 2
"""Failed checks in the first screen; the others stand with the parameters."""


@router.get("/models/{model_id}")
async def model(request: Request, context: Ctx, principal: ModelReader, row: Version, diagnose: int = -1) -> Response:
    """Show a model. `diagnose`: 1 begins a diagnosis anew, 0 begins none."""
    document = stored_model.read(row)
    measured = await measurement(context, row)
    diagnosis, job = await diagnosis_of(context, row, diagnose)
    parts = await asyncio.to_thread(gather, context, row, measured, diagnosis)
    version = await asyncio.to_thread(context.versions.document, row)
    why, findings, fit_words = parts["why"], advice.findings(document), advice.fit_sentence(document.get("fit") or {})
    running = job is not None and diagnosis is None and job.state in ("running", "completed")
    in_fit_words = ("gap", "ceiling") if fit_words else ()
    others = [finding for finding in findings if finding.gate not in in_fit_words]
    return await asyncio.to_thread(  # its charts are drawn there, and a stop must not wait for that
        page,
        request,
        "model.html",
        model=version,
        advice=advice.advice(
            version["verdict"], findings, why["likely"] if why else [], why and why["kind"],
            diagnosing=running, experiment=bool(why and why["experiment"]),
        ),
        shown_findings=others[:MOST_FINDINGS],
        hidden_findings=others[MOST_FINDINGS:],
        reasons=[] if findings else version["reasons"],
        fit_words=fit_words,
        # One that has just ended is shown as running once more: the page asks after it, and then shows the diagnosis.
        job=job.document() if job and running else None,
        why_problem=job.problem if job and job.state == "failed" else None,
        step=await next_step(context, row, version, principal),
        changes=await asyncio.to_thread(context.trend.changes_to, row),
        ask_password=not context.people.is_confirmed(principal),
        threshold_us=stored_model.threshold_us(row),
        has_key=version["served"] and await asyncio.to_thread(controllers.has_key, context.auth, row.participant),
        problem=measured["problem"],
        hdf5=not (await asyncio.to_thread(context.analyses.path, row.recording_id)).endswith(".csv"),
        may_test=principal.may(Scope.RUN_TEST),
        may_approve=principal.may(Scope.APPROVE_MODEL),
        **await facts(context, row, document),
        **parts,
    )  # fmt: skip


async def facts(context: Context, row: Model, document: dict[str, Any]) -> dict[str, Any]:
    """Collect what a model's page and its report show alike."""
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


async def next_step(
    context: Context, row: Model, version: dict[str, Any], principal: Principal
) -> next_view.Step | None:
    """Say what comes after the decision on this model; None before it: then the verdict says what to do."""
    if version["decision"] is None or not principal.may(Scope.RUN_TEST):
        return None
    participant = await asyncio.to_thread(participants.find, context, row.participant)
    step = await asyncio.to_thread(next_view.step, context, participant, principal)
    return None if step.href == f"/models/{row.id}" else step


async def measurement(context: Context, row: Model) -> dict[str, Any]:
    """Return `curves` and `comparison`, or the `problem` that keeps them from being drawn."""
    try:
        curves, comparison = await asyncio.gather(context.analyses.curves(row), context.analyses.comparison(row))
    except ApiError as error:
        return {"curves": None, "comparison": None, "problem": error}
    return {"curves": curves, "comparison": comparison, "problem": None}


async def diagnosis_of(
    context: Context, row: Model, diagnose: int
) -> tuple[dict[str, Any] | None, Job | None]:  # fmt: skip
    """Return the diagnosis if it is there; else the job that makes it, begun if nobody has."""
    known = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    if known is not None:
        return known, None
    begun = [job for job in context.jobs.all.values() if (job.kind, job.subject) == ("diagnosis", row.id)]
    newest = begun[-1] if begun else None
    if diagnose == 1 or (newest is None and diagnose != 0):
        newest = jobs.begin_diagnosis(context, row)
        await asyncio.sleep(0.05)
    if newest is not None and newest.state == "completed":  # it ended between the two looks
        known = await asyncio.to_thread(context.analyses.known_diagnosis, row)
    return known, newest


def gather(
    context: Context, row: Model, measured: dict[str, Any], diagnosis: dict[str, Any] | None
) -> dict[str, Any]:  # fmt: skip
    """Collect what is missing, where the error sits, and the versions of the recording."""
    view = explanation.view(diagnosis, measured["comparison"]) if diagnosis else None
    lineage = context.versions.lineage(row)
    rows = versions_of(context, row, lineage)
    place = [each["id"] for each in rows].index(row.id)
    later = rows[place + 1 :]
    before = diagnosis and context.analyses.experiment_before(lineage[0])
    return {
        **missing_parts(view, measured["comparison"]),
        "versions": rows,
        "earlier": rows[place - 1] if place and row.parent_id == rows[place - 1]["id"] else None,
        "undone": next((each for each in later[:1] if each["undone"]), None),
        "decided": explanation.decided(before, diagnosis, row.effects) if diagnosis else "",
        "added": {effect: each["id"] for each in later for effect in (each["added_effect"] or "").split(",")},
        "carried": carried_structure.carried_context(context.versions, row, diagnosis),
        "figures": draw(row, measured, diagnosis, view, rows),
    }


def versions_of(context: Context, row: Model, lineage: Sequence[Model] = ()) -> list[dict[str, Any]]:
    """List the versions of the model's recording; `lineage`: where it is known."""
    known = lineage or context.versions.lineage(row)
    return explanation.versions([context.versions.document(version) for version in known], row.id)


# ---- charts -------------------------------------------------------------------------------------------------


async def figures_of(context: Context, row: Model) -> Figures:
    """Draw the charts of a model's page, with those of its diagnosis once it is there."""
    measured = await measurement(context, row)

    def draw_known() -> Figures:
        diagnosis = context.analyses.known_diagnosis(row)
        view = explanation.view(diagnosis, measured["comparison"]) if diagnosis else None
        return draw(row, measured, diagnosis, view, versions_of(context, row))

    return await asyncio.to_thread(draw_known)


def draw(
    row: Model, measured: dict[str, Any], diagnosis: dict[str, Any] | None, view: dict[str, Any] | None,
    rows: list[dict[str, Any]],
) -> Figures:  # fmt: skip
    """Draw the charts of a model's page; `view` and `rows` as `gather` makes them."""
    segments = (measured["curves"] or {}).get("segments") or []
    signatures = (diagnosis or {}).get("signatures") or {}
    return Figures(
        draw_model(stored_model.read(row), measured)
        | diagnosis_charts.diagnosis_figures(measured["comparison"], segments, view, signatures, rows),
        f"/models/{row.id}/figures/{{}}",
    )


def draw_model(document: dict[str, Any], measured: dict[str, Any]) -> dict[str, Any]:
    """Draw the model's own charts; `overview` and `curve` are low enough for the first screen."""
    figures = model_charts.model_figures(document, measured["curves"], measured["comparison"])
    figures["curve"] = replace(figures["recruitment"], height=CURVE_PX)
    if "overview" in figures:
        figures["overview"] = replace(figures["overview"], height=OVERVIEW_PX)
    free = diagnosis_charts.free_effects(explanation.held_free(document))
    return figures | free | joint_charts.joint_figures(document)


# ---- long work ----------------------------------------------------------------------------------------------

TITLES = {"diagnosis": "Diagnosing", "add-effects": "Adding the effect", "improve": "Improving the model",
          FIT_TOGETHER: "Fitting one model to all recordings"}  # fmt: skip


@router.get("/jobs/{job_id}")
async def job(request: Request, context: Ctx, _principal: ModelReader, job_id: str) -> Response:
    """Show how far a job is; lead on to its result once it is done."""
    job = context.jobs.get(job_id)
    if job.result_url is not None:
        return RedirectResponse(job.result_url.removeprefix("/v1").removesuffix("/diagnosis"), 303)
    problem = job.problem if job.state == "failed" else None
    title, status = (problem.title, problem.status) if problem else (TITLES[job.kind], 200)
    return page(request, "job.html", status, job=job.document(), problem=problem, title=title)
