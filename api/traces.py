"""Traces: what one request led to, step by step, with times. Here they are made; `api.operation.telemetry` sends them.

Nothing of a person leaves in one. Names of steps stand in the code, and of what is said of a step only `SAYS` goes on,
and only in the form that stands there. An error's words are not said, since they may name a participant: its code is.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

log = logging.getLogger("stimrig.traces")


def words(pattern: str) -> Callable[[object], bool]:
    """Whether a value is text of that form."""
    form = re.compile(pattern)
    return lambda value: isinstance(value, str) and form.fullmatch(value) is not None


def number(value: object) -> bool:
    """Whether a value is a number, or true or false."""
    return isinstance(value, bool | int | float)


_CODE = words(r"[a-z][a-z0-9-]{0,39}")
SAYS: Mapping[str, Callable[[object], bool]] = {
    "http.request.method": words("[A-Z]{3,7}"),
    "http.route": words(r"/[A-Za-z0-9_.{}:/-]{0,119}"),
    "http.response.status_code": number,
    "stimrig.test.id": words(r"T\d{8}T\d{6}-[0-9a-f]{6}"),
    "stimrig.test.kind": words("pre-session|adaptive|sequence|passive|held|moving|muscles"),
    "stimrig.test.outcome": words("completed|stopped|fault"),
    "stimrig.test.state": _CODE,
    "stimrig.pulses": number,
    "stimrig.dropped_pulses": number,
    "stimrig.lateness_max_ms": number,
    "stimrig.stop.confirmed": number,
    "stimrig.stop.last_pulse_age_s": number,
    "error.type": _CODE,
}
"""What may be said of a step: its name, and the form that it must have."""
CONTEXT = re.compile(r"00-([0-9a-f]{32})-([0-9a-f]{16})-[0-9a-f]{2}")


@dataclass(frozen=True)
class Span:
    """The place of one step in its trace."""

    trace_id: str
    span_id: str

    @property
    def traceparent(self) -> str:
        """As W3C's header has it."""
        return f"00-{self.trace_id}-{self.span_id}-01"

    def below(self) -> Span:
        """A step of this one."""
        return Span(self.trace_id, secrets.token_hex(8))


@dataclass(frozen=True)
class Step:
    """A step that has ended."""

    name: str
    span: Span
    parent: Span | None
    start_unix_s: float
    end_unix_s: float
    says: Mapping[str, Any] = field(default_factory=dict)


current_span: ContextVar[Span | None] = ContextVar("span", default=None)
"""The step that is being done; log lines carry it."""


def span_of(traceparent: object) -> Span | None:
    """The step that a context names; None where it is none."""
    found = CONTEXT.fullmatch(traceparent) if isinstance(traceparent, str) else None
    return Span(found[1], found[2]) if found else None


class Tracer:
    """Makes steps; `send` takes those that have ended, at once and without waiting. None: nothing is sent."""

    def __init__(self, send: Callable[[Step], None] | None = None) -> None:
        self._send = send

    @property
    def traceparent(self) -> str | None:
        """What another process is told, so that its steps belong to this one; None where nothing is sent."""
        span = current_span.get()
        return None if self._send is None or span is None else span.traceparent

    @contextmanager
    def step(self, name: str, root: bool = False) -> Iterator[dict[str, Any]]:
        """A step, and what is said of it; `root`: the first of a new trace, or else one below the present one."""
        parent = None if root else current_span.get()
        span = parent.below() if parent else Span(secrets.token_hex(16), secrets.token_hex(8))
        token, says = current_span.set(span), {}
        start_unix_s, start_s = time.time(), time.monotonic()
        try:
            yield says
        except BaseException as error:
            says.setdefault("error.type", getattr(error, "code", None) or "internal")
            raise
        finally:
            current_span.reset(token)
            end_unix_s = start_unix_s + time.monotonic() - start_s
            self._tell(Step(says.pop("name", name), span, parent, start_unix_s, end_unix_s, says))

    def told(self, name: str, parent: Span, start_unix_s: float, end_unix_s: float, says: Mapping[str, Any]) -> Span:
        """A step that another process did, of which only the times are known."""
        span = parent.below()
        self._tell(Step(name, span, parent, start_unix_s, end_unix_s, says))
        return span

    def _tell(self, step: Step) -> None:
        if self._send is None:
            return
        try:
            self._send(step)
        except Exception as error:  # whatever is wrong with telemetry is no reason not to do what it tells of
            log.warning("a step could not be told: %s", type(error).__name__)


def allowed(says: Mapping[str, Any]) -> dict[str, Any]:
    """What of this may leave."""
    return {name: value for name, value in says.items() if name in SAYS and SAYS[name](value)}
