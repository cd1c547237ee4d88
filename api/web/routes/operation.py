"""Operation: is it alive, and its figures for Prometheus."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse, PlainTextResponse, Response
from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from sqlalchemy import text

from stimrig.api import schemas
from stimrig.api.errors import NotFoundError
from stimrig.api.outbox import status
from stimrig.api.store.tables import Model, Participant, Test
from stimrig.api.web.dependencies import Context, Ctx
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import SchemaOut, SchemasOut, describe_answer
from stimrig.api.web.responses.rig import HealthOut

router = APIRouter(tags=["operation"])


@router.get("/health", **describe_answer(HealthOut))
def health(context: Ctx) -> dict[str, Any]:
    """`ok` where database and rig answer; `degraded` says what does not. Holds nothing of any participant."""
    with context.store.read() as session:
        session.execute(text("SELECT 1"))
    newest = context.rig.status
    rig = {
        "connected": context.rig.connected,
        "state": newest.state if newest and context.rig.connected else "disconnected",
        "age_s": context.rig.age_s,
        "torque_age_s": newest.torque_age_s if newest else None,
    }
    return {
        "status": "ok" if context.rig.connected else "degraded",
        "database": "ok",
        "rig": rig,
        "uptime_s": round(time.monotonic() - context.started_s, 1),
    }


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(context: Ctx) -> Response:
    """Figures in Prometheus' text format."""
    return Response(generate_latest(Figures(lambda: figures(context))), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@dataclass(frozen=True)
class Figures:
    """Figures that are read when they are asked for: `collect` gives one family after the other."""

    collect: Callable[[], Iterator[Metric]]


def figures(context: Context) -> Iterator[Metric]:
    """The service's figures, one family after the other."""
    rig, newest = context.rig, context.runner.hub.newest
    approved = context.versions.all_approved(context.store.all(Participant.code))
    tests = GaugeMetricFamily("stimrig_tests", "Tests by state", labels=["state"])
    for state, count in sorted(Counter(row.state for row in context.store.all(Test)).items()):
        tests.add_metric([state], count)
    yield tests
    for name, words, value in (
        ("stimrig_up_seconds", "Time since start", time.monotonic() - context.started_s),
        ("stimrig_rig_connected", "1 where the rig's socket is open", float(rig.connected)),
        ("stimrig_rig_age_seconds", "Time since the rig spoke", -1.0 if rig.age_s is None else rig.age_s),
        ("stimrig_models", "Model versions", len(context.store.all(Model.id))),
        ("stimrig_approved_models", "Participants with one approved today", len(approved)),
        ("stimrig_audit_entries", "Entries of the audit trail", context.store.seen(context.clock).entry),
        ("stimrig_free_disk_bytes", "Free where the data lie", shutil.disk_usage(context.settings.data_dir).free),
        ("stimrig_live_listeners", "Open live channels", context.runner.hub.listeners),
        ("stimrig_lost_samples", "Lost in the newest test", newest.lost_samples if newest else 0),
        ("stimrig_dropped_pulses", "Dropped in it", newest.dropped_pulses if newest else 0),
        ("stimrig_jobs_queued", "Analyses waiting", len(context.pool.queue)),
    ):
        yield GaugeMetricFamily(name, words, value)
    for name, words, value in (
        ("stimrig_jobs_done_total", "Analyses done", context.pool.done_count),
        ("stimrig_jobs_failed_total", "Analyses failed", context.pool.failed_count),
        ("stimrig_jobs_busy_seconds_total", "Time in analyses", context.pool.busy_s),
    ):
        yield CounterMetricFamily(name, words, value)
    if rig.status is not None and rig.status.check is not None:
        due = float(bool(rig.status.check.due))
        yield GaugeMetricFamily("stimrig_rig_check_due", "1 where a check of the rig is due", due)
    yield from _centre(context)


def _centre(context: Context) -> Iterator[Metric]:
    """How telling the centre goes; nothing where there is none."""
    now_s = context.clock.unix_s()
    told = status.read(context.settings, now_s)
    if told is None:
        return
    since_s = told.since_contact_s(now_s)
    age_s = -1.0 if since_s is None else since_s
    for name, words, value in (
        ("stimrig_outbox_items_waiting", "Items that the centre lacks", told.items_waiting),
        ("stimrig_outbox_files_waiting", "Files that it is known to lack", told.files_waiting),
        ("stimrig_outbox_files_damaged", "Files that cannot be sent to it", told.damaged_count),
        ("stimrig_outbox_contact_age_seconds", "Time since it answered; -1: never", age_s),
    ):
        yield GaugeMetricFamily(name, words, value)


schemas_router = APIRouter(prefix="/v1/schemas", tags=["schemas"])
ONE_SCHEMA: dict[int | str, dict[str, Any]] = {
    200: {"model": SchemaOut, "description": "the schema"},
    404: problem("no schema of this name"),
}


class SchemaResponse(JSONResponse):
    """An answer that says that it is a schema."""

    media_type = "application/schema+json"


@schemas_router.get("", **describe_answer(SchemasOut))
def published() -> dict[str, Any]:
    """The schemas there are, by name, with their ids; an id ends in the version."""
    return {"schemas": {name: schemas.load(name)["$id"] for name in schemas.NAMES}}


@schemas_router.get("/{name}", response_class=SchemaResponse, response_model=None, responses=ONE_SCHEMA)
def schema(name: str) -> JSONResponse:
    """One schema, by its name or by the verb that prints it."""
    try:
        return SchemaResponse(schemas.load(name))
    except KeyError:
        raise NotFoundError("schema", name, f"There are {', '.join(schemas.NAMES)}.") from None
