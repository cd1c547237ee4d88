"""A collector of OpenTelemetry's traces on this machine: takes OTLP over HTTP, keeps the bytes, reads the steps."""

from __future__ import annotations

import gzip
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass
class Collector:
    """What came. `hold`: each request is answered only once this is set."""

    url: str = ""
    bodies: list[bytes] = field(default_factory=list)
    heads: list[str] = field(default_factory=list)
    hold: threading.Event = field(default_factory=threading.Event)

    def spans(self) -> list[Any]:
        """All steps."""
        from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

        found = [ExportTraceServiceRequest.FromString(body) for body in self.bodies]
        return [span for one in found for res in one.resource_spans for sc in res.scope_spans for span in sc.spans]


@contextmanager
def collector(answers: bool = True) -> Iterator[Collector]:
    """A collector that listens; `answers` False: it takes a request and says nothing until the end."""
    kept = Collector()
    if answers:
        kept.hold.set()

    class Door(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            packed = self.headers.get("Content-Encoding") == "gzip"
            kept.heads.append(f"{self.path}\n{self.headers}")
            kept.bodies.append(gzip.decompress(body) if packed else body)
            kept.hold.wait()
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Door)
    kept.url = f"http://127.0.0.1:{server.server_address[1]}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield kept
    finally:
        kept.hold.set()
        server.shutdown()
        server.server_close()
