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


def known(value: float | None) -> float:
    """A number, as Prometheus has no other: -1 where it is not known."""
    return -1.0 if value is None else float(value)


@dataclass(frozen=True)
class Figures:
    """The service's figures, read when they are asked for."""

    context: Context

    def collect(self) -> Iterator[Metric]:
        """Give one family after the other; the values of one with a label are listed by that."""
        context = self.context
        rig, pool, store, hub = context.rig, context.pool, context.store, context.runner.hub
        status, newest = rig.status, hub.newest
        now = status.state if status and rig.connected else "disconnected"
        summary = status.finished.summary if status and status.finished else {}
        approved = context.versions.all_approved(store.all(Participant.code))
        entries = store.first(AuditEntry.seq, order=AuditEntry.seq.desc())

        def quantiles(key: str) -> dict[str, float]:
            levels = {label: (summary.get(key) or {}).get(level) for label, level in QUANTILES.items()}
            return {label: 1e-3 * level for label, level in levels.items() if isinstance(level, float | int)}

        for name, words, label, value in (
            ("tests", "Tests by state", "state", dict(sorted(Counter(store.all(Test.state)).items()))),
            ("rig_state", "1 for the state that the rig is in", "state",
             {name: float(name == now) for name in get_args(RigState)}),
            ("pulse_lateness_seconds", "Of the pulses of the newest test that ended", "quantile",
             quantiles("lateness_ms")),
            ("pulse_acknowledgement_seconds", "From a pulse to its acknowledgement, in it", "quantile",
             quantiles("ack_delay_ms")),
            ("rig_connected", "1 where the rig's socket is open", "", float(rig.connected)),
            ("rig_age_seconds", "Time since the rig spoke; -1: never", "", known(rig.age_s)),
            ("rig_torque_age_seconds", "Age of the newest torque; -1: none", "",
             known(status.torque_age_s if status else None)),
            ("live_listeners", "Open live channels", "", hub.listeners),
            ("lost_samples", "Lost in the newest test", "", newest.lost_samples if newest else 0),
            ("dropped_pulses", "Dropped in it", "", newest.dropped_pulses if newest else 0),
            ("models", "Model versions", "", len(store.all(Model.id))),
            ("approved_models", "Participants with one approved today", "", len(approved)),
            ("audit_entries", "Entries of the audit trail", "", entries or 0),
            ("free_disk_bytes", "Free where the data lie", "", shutil.disk_usage(context.settings.data_dir).free),
            ("jobs_queued", "Analyses waiting", "", len(pool.queue)),
            ("up_seconds", "Time since start", "", time.monotonic() - context.started_s),
            ("jobs_done_total", "Analyses done", "", pool.done_count),
            ("jobs_failed_total", "Analyses failed", "", pool.failed_count),
            ("jobs_busy_seconds_total", "Time in analyses", "", pool.busy_s),
            ("build_info", "1; the label names the release", "version", {software_version(): 1.0}),
        ):  # fmt: skip
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            family = kind(f"stimrig_{name}", words, labels=[label] if label else [])
            for key, number in value.items() if isinstance(value, dict) else [(None, value)]:
                family.add_metric([] if key is None else [key], number)
            yield family
        yield from context.stops.registry.collect()
