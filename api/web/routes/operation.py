"""Operation: is it alive, and its figures for Prometheus."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from sqlalchemy import func, select, text

from api.store.tables import AuditEntry, Model, Participant, Test
from api.web.dependencies import Context, Ctx

router = APIRouter(tags=["operation"])


@router.get("/health")
def health(context: Ctx) -> dict[str, Any]:
    """`ok` where database and rig answer; `degraded` says what does not. Holds nothing of any participant."""
    with context.store.read() as session:
        session.execute(text("SELECT 1"))
    status = context.rig.status
    rig = {
        "connected": context.rig.connected,
        "state": status.state if status and context.rig.connected else "disconnected",
        "age_s": context.rig.age_s,
        "torque_age_s": status.torque_age_s if status else None,
    }
    return {
        "status": "ok" if context.rig.connected else "degraded",
        "database": "ok",
        "rig": rig,
        "uptime_s": round(time.monotonic() - context.started_s, 1),
    }


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(context: Ctx) -> PlainTextResponse:
    """Figures in Prometheus' text format."""
    lines = [line for name, kind, text_, values in _figures(context) for line in _family(name, kind, text_, values)]
    return PlainTextResponse("\n".join(lines) + "\n", media_type="text/plain; version=0.0.4")


def _figures(context: Context) -> list[tuple[str, str, str, dict[str, float]]]:
    states = Counter(row.state for row in context.store.all(Test))
    newest, rig = context.runner.hub.newest, context.rig
    return [
        ("stimrig_up_seconds", "gauge", "Time since start", {"": time.monotonic() - context.started_s}),
        ("stimrig_rig_connected", "gauge", "1 where the rig's socket is open", {"": float(rig.connected)}),
        (
            "stimrig_rig_age_seconds",
            "gauge",
            "Time since the rig spoke",
            {"": -1.0 if rig.age_s is None else rig.age_s},
        ),
        ("stimrig_tests", "gauge", "Tests by state", {f'{{state="{name}"}}': float(n) for name, n in states.items()}),
        ("stimrig_models", "gauge", "Model versions", {"": float(len(context.store.all(Model.id)))}),
        ("stimrig_approved_models", "gauge", "Participants with one approved today", {"": float(_approved(context))}),
        ("stimrig_audit_entries", "gauge", "Entries of the audit trail", {"": float(_audit_entries(context))}),
        ("stimrig_free_disk_bytes", "gauge", "Free where the data lie", {"": float(_free_bytes(context))}),
        ("stimrig_live_listeners", "gauge", "Open live channels", {"": float(context.runner.hub.listeners)}),
        ("stimrig_lost_samples", "gauge", "Lost in the newest test", {"": float(newest.lost_samples if newest else 0)}),
        ("stimrig_dropped_pulses", "gauge", "Dropped in it", {"": float(newest.dropped_pulses if newest else 0)}),
        ("stimrig_jobs_done_total", "counter", "Analyses done", {"": float(context.pool.done_count)}),
        ("stimrig_jobs_failed_total", "counter", "Analyses failed", {"": float(context.pool.failed_count)}),
        ("stimrig_jobs_busy_seconds_total", "counter", "Time in analyses", {"": context.pool.busy_s}),
        ("stimrig_jobs_queued", "gauge", "Analyses waiting", {"": float(len(context.pool.queue))}),
    ]


def _approved(context: Context) -> int:
    return sum(context.versions.served(code) is not None for code in context.store.all(Participant.code))


def _audit_entries(context: Context) -> int:
    with context.store.read() as session:
        return session.scalar(select(func.max(AuditEntry.seq))) or 0


def _free_bytes(context: Context) -> int:
    return shutil.disk_usage(context.settings.data_dir).free


def _family(name: str, kind: str, words: str, values: dict[str, float]) -> list[str]:
    rows = [f"{name}{labels} {value:.10g}" for labels, value in sorted(values.items())]
    return [f"# HELP {name} {words}", f"# TYPE {name} {kind}", *rows]
