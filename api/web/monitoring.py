"""The service's figures for Prometheus; docs/operation.md lists them. No label holds anything of a person."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from stimrig.api.store.tables import AuditEntry, Model, Participant, Test
from stimrig.api.version import software_version
from stimrig.api.web.dependencies import Context
from stimrig.rig.messages import RigState

QUANTILES = {"0.5": "median", "0.99": "p99", "1": "max"}


def gauge(name: str, words: str, label: str, values: dict[str, float]) -> Metric:
    """A gauge with one label."""
    family = GaugeMetricFamily(f"stimrig_{name}", words, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def known(value: float | None) -> float:
    """A number, as Prometheus has no other: -1 where it is not known."""
    return -1.0 if value is None else float(value)


@dataclass(frozen=True)
class Figures:
    """The service's figures, read when they are asked for."""

    context: Context

    def collect(self) -> Iterator[Metric]:
        """Give one family after the other."""
        context = self.context
        rig, pool, store, hub = context.rig, context.pool, context.store, context.runner.hub
        status, newest = rig.status, hub.newest
        now = status.state if status and rig.connected else "disconnected"
        yield gauge("tests", "Tests by state", "state", dict(sorted(Counter(store.all(Test.state)).items())))
        states = {name: float(name == now) for name in get_args(RigState)}
        yield gauge("rig_state", "1 for the state that the rig is in", "state", states)
        summary = status.finished.summary if status and status.finished else {}
        for name, words, key in (
            ("pulse_lateness_seconds", "Of the pulses of the newest test that ended", "lateness_ms"),
            ("pulse_acknowledgement_seconds", "From a pulse to its acknowledgement, in it", "ack_delay_ms"),
        ):
            levels = {label: (summary.get(key) or {}).get(level) for label, level in QUANTILES.items()}
            values = {label: 1e-3 * level for label, level in levels.items() if isinstance(level, float | int)}
            yield gauge(name, words, "quantile", values)
        approved = context.versions.all_approved(store.all(Participant.code))
        entries = store.first(AuditEntry.seq, order=AuditEntry.seq.desc())
        for name, words, value in (
            ("rig_connected", "1 where the rig's socket is open", float(rig.connected)),
            ("rig_age_seconds", "Time since the rig spoke; -1: never", known(rig.age_s)),
            (
                "rig_torque_age_seconds",
                "Age of the newest torque; -1: none",
                known(None if status is None else status.torque_age_s),
            ),
            ("live_listeners", "Open live channels", hub.listeners),
            ("lost_samples", "Lost in the newest test", newest.lost_samples if newest else 0),
            ("dropped_pulses", "Dropped in it", newest.dropped_pulses if newest else 0),
            ("models", "Model versions", len(store.all(Model.id))),
            ("approved_models", "Participants with one approved today", len(approved)),
            ("audit_entries", "Entries of the audit trail", entries or 0),
            ("free_disk_bytes", "Free where the data lie", shutil.disk_usage(context.settings.data_dir).free),
            ("jobs_queued", "Analyses waiting", len(pool.queue)),
            ("up_seconds", "Time since start", time.monotonic() - context.started_s),
        ):
            yield GaugeMetricFamily(f"stimrig_{name}", words, value)
        for name, words, value in (
            ("jobs_done_total", "Analyses done", pool.done_count),
            ("jobs_failed_total", "Analyses failed", pool.failed_count),
            ("jobs_busy_seconds_total", "Time in analyses", pool.busy_s),
        ):
            yield CounterMetricFamily(f"stimrig_{name}", words, value)
        yield gauge("build_info", "1; the label names the release", "version", {software_version(): 1.0})
        yield from context.stops.registry.collect()
