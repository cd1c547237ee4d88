"""Counts of stops for `/metrics`; no label holds anything of a person."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import Metric

STOP_BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
STOP_ENDS = ("confirmed", "not-confirmed", "failed")
"""`not-confirmed`: the rig answered without evidence; `failed`: it did not answer."""


class StopCounter:
    """Stops, and how long each took to be confirmed."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._stops = Counter("stimrig_stops", "Stops by what came of them", ["outcome"], registry=self.registry)
        self._seconds = Histogram(
            "stimrig_stop_confirmation_seconds", "From the stop's request to the rig's evidence",
            buckets=STOP_BUCKETS_S, registry=self.registry,
        )  # fmt: skip
        for outcome in STOP_ENDS:
            self._stops.labels(outcome)  # exports 0 as well

    def stopped(self, outcome: str, took_s: float) -> None:
        """A stop has ended; `outcome` of `STOP_ENDS`."""
        self._stops.labels(outcome).inc()
        if outcome != "failed":
            self._seconds.observe(took_s)

    def collect(self) -> Iterator[Metric]:
        """The families, without the times at which they were made."""
        for family in self.registry.collect():
            family.samples = [sample for sample in family.samples if not sample.name.endswith("_created")]
            yield family
