"""The service's figures for Prometheus; docs/operation.md lists them. No label holds anything of a person."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from stimrig.api.store.tables import AuditEntry, Model, Participant, Test
from stimrig.api.version import software_version
from stimrig.api.web.dependencies import Context
from stimrig.rig.messages import RigState

QUANTILES = {"median": "0.5", "p99": "0.99", "max": "1"}


@dataclass(frozen=True)
class Figures:
    """The service's figures, read when they are asked for."""

    context: Context

    def collect(self) -> Iterator[Metric]:
        """Give one family after the other."""
        for part in (_tests, _rig, _pulses, _store, _jobs, _operation):
            yield from part(self.context)
        yield from self.context.stops.registry.collect()


def gauges(rows: Iterable[tuple[str, str, float]]) -> Iterator[Metric]:
    """Gauges without labels: name, words, value."""
    for name, words, value in rows:
        yield GaugeMetricFamily(name, words, value)


def by_label(name: str, words: str, label: str, values: dict[str, float]) -> Metric:
    """A gauge with one label."""
    family = GaugeMetricFamily(name, words, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def known(value: float | None) -> float:
    """A number, as Prometheus has no other: -1 where it is not known."""
    return -1.0 if value is None else float(value)


def _tests(context: Context) -> Iterator[Metric]:
    states = Counter(row.state for row in context.store.all(Test))
    yield by_label("stimrig_tests", "Tests by state", "state", dict(sorted(states.items())))


def _rig(context: Context) -> Iterator[Metric]:
    rig = context.rig
    now = rig.status.state if rig.status and rig.connected else "disconnected"
    states = {name: float(name == now) for name in get_args(RigState)}
    yield by_label("stimrig_rig_state", "1 for the state that the rig is in", "state", states)
    torque_s = rig.status.torque_age_s if rig.status else None
    yield from gauges((
        ("stimrig_rig_connected", "1 where the rig's socket is open", float(rig.connected)),
        ("stimrig_rig_age_seconds", "Time since the rig spoke; -1: never", known(rig.age_s)),
        ("stimrig_rig_torque_age_seconds", "Age of the newest torque; -1: none", known(torque_s)),
    ))  # fmt: skip


def _pulses(context: Context) -> Iterator[Metric]:
    """Of the newest test: what is lost while it runs, and how late its pulses were once it has ended."""
    newest, rig = context.runner.hub.newest, context.rig.status
    summary = rig.finished.summary if rig and rig.finished else {}
    for name, words, key in (
        ("stimrig_pulse_lateness_seconds", "Of the pulses of the newest test that ended", "lateness_ms"),
        ("stimrig_pulse_acknowledgement_seconds", "From a pulse to its acknowledgement, in it", "ack_delay_ms"),
    ):
        quantiles = summary.get(key) or {}
        values = {
            QUANTILES[level]: 1e-3 * quantiles[level]
            for level in QUANTILES
            if isinstance(quantiles.get(level), float | int)
        }
        yield by_label(name, words, "quantile", values)
    yield from gauges((
        ("stimrig_live_listeners", "Open live channels", context.runner.hub.listeners),
        ("stimrig_lost_samples", "Lost in the newest test", newest.lost_samples if newest else 0),
        ("stimrig_dropped_pulses", "Dropped in it", newest.dropped_pulses if newest else 0),
    ))  # fmt: skip


def _store(context: Context) -> Iterator[Metric]:
    approved = context.versions.all_approved(context.store.all(Participant.code))
    entries = context.store.first(AuditEntry.seq, order=AuditEntry.seq.desc())
    yield from gauges((
        ("stimrig_models", "Model versions", len(context.store.all(Model.id))),
        ("stimrig_approved_models", "Participants with one approved today", len(approved)),
        ("stimrig_audit_entries", "Entries of the audit trail", entries or 0),
        ("stimrig_free_disk_bytes", "Free where the data lie", shutil.disk_usage(context.settings.data_dir).free),
    ))  # fmt: skip


def _jobs(context: Context) -> Iterator[Metric]:
    pool = context.pool
    yield GaugeMetricFamily("stimrig_jobs_queued", "Analyses waiting", len(pool.queue))
    for name, words, value in (
        ("stimrig_jobs_done_total", "Analyses done", pool.done_count),
        ("stimrig_jobs_failed_total", "Analyses failed", pool.failed_count),
        ("stimrig_jobs_busy_seconds_total", "Time in analyses", pool.busy_s),
    ):
        yield CounterMetricFamily(name, words, value)


def _operation(context: Context) -> Iterator[Metric]:
    """The process."""
    yield by_label("stimrig_build_info", "1; the label names the release", "version", {software_version(): 1.0})
    yield from gauges((("stimrig_up_seconds", "Time since start", time.monotonic() - context.started_s),))
