"""Sends traces to a collector by OTLP over HTTP (OpenTelemetry), where one is named. Nothing waits for it.

Steps go into a queue of bounded length, which a thread empties. What does not fit, or is not taken, is dropped.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from stimrig.api.errors import SettingsError
from stimrig.api.settings import Settings, loopback
from stimrig.api.traces import Span, Step, Tracer, allowed
from stimrig.api.version import software_version

STANDARD = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")
SEND_S, CLOSE_S = 5.0, 2.0
"""So long one attempt may take, and so long the end of the service waits for what is left."""
LONGEST_QUEUE = 4096
NANO = 1e9


def endpoint_of(settings: Settings, environment: Mapping[str, str] = os.environ) -> str | None:
    """Where traces go; None: nowhere.

    Raises SettingsError: it is no address, or would be reached in the clear over a network.
    """
    base = settings.otlp_endpoint or environment.get(STANDARD[1])
    found = environment.get(STANDARD[0]) if not settings.otlp_endpoint else None
    found = found or (base and base.rstrip("/") + ("" if urlsplit(base).path.strip("/") else "/v1/traces"))
    if not found:
        return None
    parts = urlsplit(found)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SettingsError("STIMRIG_OTLP_ENDPOINT: it is no address; give one like http://127.0.0.1:4318")
    if parts.scheme == "http" and not loopback(parts.hostname):
        raise SettingsError(
            "STIMRIG_OTLP_ENDPOINT: in the clear only to this machine; give one that begins with https://"
        )
    return found


class Telemetry(Tracer):
    """A tracer whose steps are sent where the settings say, or nowhere.

    Raises SettingsError: the address does not hold, or OpenTelemetry is not installed.
    """

    def __init__(self, settings: Settings) -> None:
        endpoint = endpoint_of(settings)
        self._provider: Any = provider_to(endpoint) if endpoint else None
        super().__init__(Sender(self._provider) if self._provider else None)

    def close(self) -> None:
        """Send what is left, for a moment."""
        if self._provider is not None:
            last = threading.Thread(target=self._provider.shutdown, daemon=True)
            last.start()
            last.join(CLOSE_S)


def provider_to(endpoint: str) -> Any:
    """OpenTelemetry's way to a collector. Raises SettingsError: it is not installed."""
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError:
        raise SettingsError(
            "STIMRIG_OTLP_ENDPOINT: traces need OpenTelemetry; pip install 'stimrig[telemetry]'"
        ) from None
    # not `Resource.create`, which adds what the environment and the machine say of themselves
    resource = Resource({"service.name": "stimrig", "service.version": software_version()})
    ids: Any = Prepared()  # what OpenTelemetry asks of a generator; its class is there only where it is installed
    provider = TracerProvider(resource=resource, id_generator=ids, shutdown_on_exit=False)
    exporter = OTLPSpanExporter(endpoint=endpoint, timeout=SEND_S)
    queue = BatchSpanProcessor(exporter, max_queue_size=LONGEST_QUEUE, max_export_batch_size=min(LONGEST_QUEUE, 512))
    provider.add_span_processor(queue)
    return provider


class Prepared:
    """OpenTelemetry draws its ids from here: they were drawn when the step began."""

    def __init__(self) -> None:
        self.span = Span("1" * 32, "1" * 16)

    def generate_trace_id(self) -> int:
        """Of the step that is being sent."""
        return int(self.span.trace_id, 16)

    def generate_span_id(self) -> int:
        """As above."""
        return int(self.span.span_id, 16)

    def is_trace_id_random(self) -> bool:
        """They are drawn by `secrets`."""
        return True


class Sender:
    """Hands a step to OpenTelemetry's queue; what may not leave is left out here, and nowhere else."""

    def __init__(self, provider: Any) -> None:
        self._tracer, self._ids, self._turn = provider.get_tracer("stimrig"), provider.id_generator, threading.Lock()

    def __call__(self, step: Step) -> None:
        from opentelemetry import trace

        context = trace.set_span_in_context(trace.INVALID_SPAN)
        if step.parent is not None:
            flags, above = trace.TraceFlags(trace.TraceFlags.SAMPLED), step.parent
            place = trace.SpanContext(
                int(above.trace_id, 16), int(above.span_id, 16), is_remote=False, trace_flags=flags
            )
            context = trace.set_span_in_context(trace.NonRecordingSpan(place))
        kind = trace.SpanKind.INTERNAL if step.parent else trace.SpanKind.SERVER
        with self._turn:
            self._ids.span = step.span
            span = self._tracer.start_span(
                step.name, context, kind, allowed(step.says), start_time=int(step.start_unix_s * NANO)
            )
        if "error.type" in step.says:
            span.set_status(trace.StatusCode.ERROR)
        span.end(int(step.end_unix_s * NANO))
