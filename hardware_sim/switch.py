"""A SCPI relay matrix between one output of the stimulator and the elements of an array: relay n leads to element n.

SCPI-99 in short or long form, a line each: `*IDN?`, `*RST`, `*CLS`, `*OPC?`, `ROUT:OPEN:ALL`, `ROUT:OPEN (@1,5)`,
`ROUT:CLOS (@1,5)`, `ROUT:CLOS? (@1,5)`, `SYST:ERR?`. Lists may have ranges (`@1:3`). Commands are done one after
another; relays open within 2 ms and close within 5 ms, and none closes before those that were told to open are open.
`ROUT:CLOS?` tells where the contacts are, not where they should be.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from typing import Any

from stimrig.hardware_sim.timeline import Timeline

IDENTITY = "STIMRIG,EMULATED-MATRIX-{relays},0001,1.0"
OPENS_S, CLOSES_S = 0.002, 0.005
LONGEST_LINE, LONGEST_QUEUE = 256, 10
NO_ERROR, OVERFLOW = '0,"No error"', '-350,"Queue overflow"'
SYNTAX, HEADER, RANGE = '-102,"Syntax error"', '-113,"Undefined header"', '-222,"Data out of range"'
_ROUTE = re.compile(r":?ROUT(?:E)?:(OPEN|CLOS(?:E)?)(:ALL|\?)?(?:\s+(.*))?")
_LIST = re.compile(r"\(@\s*(\d{1,4}(?:\s*:\s*\d{1,4})?(?:\s*,\s*\d{1,4}(?:\s*:\s*\d{1,4})?)*)\s*\)")


class RelayMatrix:
    """The matrix; at power-up all relays are open. `write` sends bytes to the host."""

    def __init__(self, timeline: Timeline, relays: int, write: Callable[[bytes], None]) -> None:
        self.relays, self.stuck = relays, dict[int, bool]()
        self.outgoing: list[Callable[[str], str | None]] = []
        self._timeline, self._write = timeline, write
        self._waiting: list[str] = []
        self.reset()

    def reset(self) -> None:
        """Power lost and back: all relays are open, and what was being done is forgotten."""
        self._closed: set[int] = set()
        self._lines: deque[str] = deque()
        self._errors: deque[str] = deque()
        self._received = b""
        self._settled_s = self._timeline.now_s
        self._life = object()
        self._waits = False

    @property
    def closed(self) -> tuple[int, ...]:
        """Relays whose contacts are closed."""
        free = {relay for relay in self._closed if self.stuck.get(relay, True)}
        return tuple(sorted(free | {relay for relay, closed in self.stuck.items() if closed}))

    def received(self, data: bytes) -> None:
        """Bytes from the host."""
        *lines, rest = (self._received + data).split(b"\n")
        self._received = rest[-LONGEST_LINE:]
        self._lines.extend(line.decode("ascii", "replace").strip().upper() for line in lines)
        self._work()

    def state(self) -> dict[str, Any]:
        """For the control line."""
        return {"closed": list(self.closed), "settled": self._timeline.now_s >= self._settled_s}

    def _work(self) -> None:
        while self._lines and not self._waits:
            line = self._lines.popleft()
            if line == "*OPC?":
                self._waits = True
                self._later(0.0, self._complete)
            elif line:
                self._do(line)

    def _complete(self) -> None:
        self._waits = False
        self._answer("1")
        self._work()

    def _do(self, line: str) -> None:
        if line == "*IDN?":
            self._answer(IDENTITY.format(relays=self.relays))
        elif line == "*RST":
            self._set(OPENS_S, range(1, self.relays + 1), False)
        elif line == "*CLS":
            self._errors.clear()
        elif re.fullmatch(r":?SYST(EM)?:ERR(OR)?(:NEXT)?\?", line):
            self._answer(self._errors.popleft() if self._errors else NO_ERROR)
        elif route := _ROUTE.fullmatch(line):
            self._route(*route.groups())
        else:
            self._fail(HEADER)

    def _route(self, verb: str, kind: str | None, listed: str | None) -> None:
        closes = verb != "OPEN"
        if kind == ":ALL" and not closes and listed is None:
            self._set(OPENS_S, range(1, self.relays + 1), False)
            return
        relays = _relays(listed or "")
        if kind == ":ALL" or not relays:
            self._fail(HEADER if kind == ":ALL" else SYNTAX)
        elif not all(1 <= relay <= self.relays for relay in relays):
            self._fail(RANGE)
        elif kind:
            self._answer(",".join(str(int((relay in self.closed) == closes)) for relay in relays))
        else:
            self._set(CLOSES_S if closes else OPENS_S, relays, closes)

    def _set(self, delay_s: float, relays: Any, closed: bool) -> None:
        change = self._closed.update if closed else self._closed.difference_update
        self._settled_s = max(self._settled_s, self._timeline.now_s) + delay_s
        self._later(0.0, lambda: change(relays))

    def _later(self, delay_s: float, do: Callable[[], None]) -> None:
        """Once the relays have settled, unless power was lost."""
        life = self._life
        at_s = max(self._settled_s, self._timeline.now_s) + delay_s
        self._timeline.at(at_s, lambda: do() if life is self._life else None)

    def _fail(self, error: str) -> None:
        if len(self._errors) < LONGEST_QUEUE:
            self._errors.append(error)
        else:
            self._errors[-1] = OVERFLOW

    def _answer(self, text: str) -> None:
        answer: str | None = text
        for hook in self.outgoing:
            answer = hook(answer) if answer is not None else None
        if answer is not None:
            self._write(answer.encode() + b"\n")


def _relays(listed: str) -> list[int]:
    """Numbers of a channel list; none where it is malformed."""
    found = _LIST.fullmatch(listed.strip())
    relays: list[int] = []
    for part in found.group(1).split(",") if found else ():
        first, _, last = part.partition(":")
        relays += range(int(first), int(last or first) + 1)
    return relays
