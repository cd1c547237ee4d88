"""The people at the rig: their requests, which may be lost or come late, and what they were told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from pydantic import ValidationError

from stimrig.rig.control.replies import id_of, refusal, to_line
from stimrig.rig.control.rig import Rig, obey, read_request
from stimrig.rig.messages import Event, FinishedEvent, Reply, StateEvent
from stimrig.rig.requests import RearmRequest, StopRequest
from tests.simulator.host import Process
from tests.simulator.world import World

TRANSIT_S = 0.0005, 0.02


@dataclass
class Asked:
    """One request: when it was sent, when the rig obeyed it (None: it never came), and the reply that came back."""

    kind: str
    sent_s: float
    process: Process
    obeyed_s: float | None = None
    place: int = 0
    """Among the requests that were obeyed, as several may come in one moment."""
    replied_s: float | None = None
    """When the rig replied, also where the reply was lost."""
    reply: Reply | None = None
    about: str = ""
    latch: str = ""
    """Of a re-arm."""
    lets_go: bool = False
    """Whether a calibration's result need not wait after it."""
    armed: bool = False
    """Whether the stimulator could stimulate as the rig replied."""
    then: Callable[[Asked], None] = lambda _: None
    """Called when the reply has come."""


class OnMessage(NamedTuple):
    """A state that a rig's process told, and when."""

    time_s: float
    process: Process
    state: str
    latch: str
    calibrated: str
    """The calibration whose result waits to be stored."""
    reason: str


@dataclass
class Clinic:
    """Sends requests and keeps what came back."""

    world: World
    device: Callable[[], dict[str, Any]]
    """What the devices are in."""
    asked: list[Asked] = field(default_factory=list)
    states: list[OnMessage] = field(default_factory=list)
    shown: dict[str, float] = field(default_factory=dict)
    """Each latch that was told, and when first."""
    finished: list[FinishedEvent] = field(default_factory=list)
    places: Iterator[int] = field(default_factory=count)
    loses: float = 0.0
    """Odds that a request or a reply is lost."""
    dies_after_stop_s: float | None = None
    """How long after its answer to the next stop the process dies."""
    kill: Callable[[], None] = lambda: None
    process: Process | None = None
    rig: Rig | None = None
    state: str = "disconnected"
    latch: str = ""
    """What a page shows now."""
    calibrated: str = ""
    """Whose result waits to be stored."""
    tests: int = 0

    def meet(self, process: Process, rig: Rig) -> None:
        """From now on requests go to this process."""
        self.process, self.rig, self.state = process, rig, "disconnected"

    def hear(self, process: Process, event: Event) -> None:
        """What the rig tells everybody."""
        time_s = process.computer.true_s
        if isinstance(event, StateEvent):
            state = event.status.state
            waits = event.status.calibrated
            calibrated = "" if waits is None else waits.calibration_id
            self.states.append(OnMessage(time_s, process, state, event.status.latch, calibrated, event.status.reason))
            self.shown.setdefault(event.status.latch, time_s)
            self.world.tell("rig", f"{state} {event.status.reason}".rstrip(), time_s)
            if process is self.process:
                self.state, self.latch, self.calibrated = state, event.status.latch, calibrated
        elif isinstance(event, FinishedEvent):
            self.finished.append(event)
            self.world.tell("rig", f"finished {event.test_id} {event.outcome} {event.reason}".rstrip(), time_s)

    def ask(self, request: Any, about: str = "") -> Asked:
        """Send a request."""
        process, rig, chance = self.process, self.rig, self.world.chance
        assert process is not None
        assert rig is not None
        latch = request.latch if isinstance(request, RearmRequest) else ""
        lets_go = request.kind == "calibrate-stored" or getattr(request, "discard", False)
        asked = Asked(request.kind, self.world.now_s, process, about=about, latch=latch, lets_go=lets_go)
        self.asked.append(asked)
        self.world.tell("people", f"{request.kind} {about}".rstrip())
        line, lost = to_line(request), chance.random() < self.loses
        back_s, back_lost = chance.uniform(*TRANSIT_S), chance.random() < self.loses

        async def obey() -> None:
            asked.obeyed_s, asked.place = process.computer.true_s, next(self.places)
            asked.reply = await answer(rig, line)
            asked.replied_s = process.computer.true_s
            asked.armed = self.device()["mode"] not in ("none", "start")
            if asked.kind == "stop" and self.dies_after_stop_s is not None:
                self.world.at(asked.replied_s + self.dies_after_stop_s, self.kill)
                self.dies_after_stop_s = None
            problem = "" if asked.reply.problem is None else asked.reply.problem.detail
            self.world.tell("reply", f"{asked.kind} {asked.reply.ok} {problem}".rstrip(), asked.replied_s)
            if not back_lost:
                self.world.at(asked.replied_s + back_s, lambda: asked.then(asked))

        def arrive() -> None:
            if process.listens:
                process.post(lambda: process.tasks.begin(obey(), "request"))

        if lost:
            self.world.tell("people", "it is lost")
        else:
            arrives_s = self.world.now_s + chance.uniform(*TRANSIT_S)
            self.world.at(arrives_s, arrive)
        return asked

    def stop(self) -> Asked:
        """Press stop."""
        return self.ask(StopRequest(id=1, reason="somebody pressed", by="nurse"))


async def answer(rig: Rig, line: bytes) -> Reply:
    """Obey a line of JSON, as the server does."""
    try:
        request = read_request(line)
    except ValidationError as error:
        return refusal(id_of(line), error)
    return await obey(rig, request)
