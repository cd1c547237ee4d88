"""Operation: is it alive, and its figures for Prometheus."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from sqlalchemy import text

from stimrig.api.centre import warnings
from stimrig.api.centre.context import Context, Ctx
from stimrig.api.centre.responses import CentreHealthOut
from stimrig.api.clock import unix_of
from stimrig.api.web.responses.base import answers

router = APIRouter(tags=["operation"])


@router.get("/health", **answers(CentreHealthOut))
def health(context: Ctx) -> dict[str, Any]:
    """`ok` where database and bucket answer; `degraded` where the bucket does not. Holds nothing of any participant."""
    with context.store.read() as session:
        session.execute(text("SELECT 1"))
    trouble = context.bucket.trouble
    return {
        "status": "degraded" if trouble else "ok", "database": "ok", "files": "failed" if trouble else "ok",
        "uptime_s": round(time.monotonic() - context.started_s, 1),
    }  # fmt: skip


@router.get("/metrics", response_class=PlainTextResponse)
def metrics(context: Ctx) -> Response:
    """Figures in Prometheus' text format."""
    return Response(generate_latest(_Figures(context)), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@dataclass
class _Figures:
    """The centre's figures, read when they are asked for."""

    context: Context

    def collect(self) -> Iterator[Metric]:
        """One family after the other."""
        context = self.context
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
