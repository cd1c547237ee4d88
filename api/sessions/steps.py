"""The rig's steps of a traced test or stop, as it told them afterwards: the service sends them on for it."""

from __future__ import annotations

from typing import Any

from stimrig.api.traces import Span, Tracer, span_of
from stimrig.rig.messages import FinishedEvent, StopAnswer, StopEvidence, Traced

PARTS = (
    ("rig: plan check", "received", "checked"),
    ("rig: journal, sensors, gate", "checked", "begun"),
    ("rig: first pulse to its acknowledgement", "first_sent", "first_acknowledged"),
    ("rig: stimulation", "begun", "ended"),
    ("rig: confirmed stop, sealing", "ended", "sealed"),
)
"""Parts of a test, each from one step to another."""


def tell_test(tracer: Tracer, event: FinishedEvent) -> Span | None:
    """Tell a test's steps; the one that the service's own are to be put below. None: nobody traces it."""
    told, parent = event.traced, span_of(event.traced and event.traced.traceparent)
    if told is None or parent is None:
        return None
    lateness_ms = event.summary.get("lateness_ms") or {}
    says = {
        "stimrig.test.id": event.test_id, "stimrig.test.outcome": event.outcome,
        "stimrig.pulses": event.summary.get("pulses"), "stimrig.lateness_max_ms": lateness_ms.get("max"),
        "stimrig.dropped_pulses": event.summary.get("dropped_pulses"),
    }  # fmt: skip
    whole = _tell(tracer, told, parent, ("rig: test", "received", "sealed"), says)
    for part in PARTS:
        _tell(tracer, told, whole or parent, part, {})
    return whole or parent


def tell_stop(tracer: Tracer, answer: StopAnswer, says: dict[str, Any]) -> StopEvidence:
    """Tell a stop's steps; the evidence as people are shown it, without them."""
    says |= {
        "stimrig.stop.confirmed": answer.confirmed, "stimrig.stop.last_pulse_age_s": answer.last_pulse_age_s
    }  # fmt: skip
    told, parent = answer.traced, span_of(answer.traced and answer.traced.traceparent)
    if told is not None and parent is not None:
        _tell(tracer, told, parent, ("rig: stop to its evidence", "received", "confirmed"), {})
    return StopEvidence.model_construct(**{name: getattr(answer, name) for name in StopEvidence.model_fields})


def _tell(
    tracer: Tracer, told: Traced, parent: Span, part: tuple[str, str, str], says: dict[str, Any]
) -> Span | None:  # fmt: skip
    name, start, end = part
    at = told.at_unix_s
    return tracer.told(name, parent, at[start], at[end], says) if start in at and end in at else None
