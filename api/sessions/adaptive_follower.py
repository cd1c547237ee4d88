"""Follows a test that stops itself: at each boundary asks the adviser what to play, and has the rig lay it.

The rig never waits under current. An answer that comes late costs rest. What comes far too late falls away: the fixed
plan's next piece plays, and the next boundary is decided with the longer record. Each boundary is asked about twice:
early, so that there is an answer whatever happens, and late, with the newest samples, which then starts from the early
answer's fit and is quick.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from base64 import b64decode
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.jobs.pool import Pool
from stimrig.api.sessions.kinds import SERVICE, Planned, Watched, Watcher, WatchStatus
from stimrig.rig.messages import AHEAD, SAFE_END_S, LiveEvent, SegmentPlan
from stimrig.rig.requests import EnoughRequest, ExtendRequest

EARLY_S = 0.75
"""Before the rig decides on a boundary: the first question."""
LATE_S = 0.35
"""The second one, with the newest samples."""
SEND_S = 0.06
"""The early answer is sent if the late one is not there."""
LEAST_S = 2.0
"""A shorter record is not informative. To it come one pulse whose samples are in transit and one incomplete pulse."""
SHORTEST_PIECE_S = 1.0
"""Shortest chosen piece, s."""


@dataclass
class AdaptiveStatus(WatchStatus):
    """State of the test: choosing; fixed (the fixed plan plays on, `problem` says why); ending."""

    words: str = ""
    knowledge: dict[str, Any] | None = None
    least_known: dict[str, Any] | None = None
    decisions: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class News:
    """Events since the last request to the adviser: samples, and the outcomes of pulses by column."""

    samples: bytes = b""
    outcomes: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, event: LiveEvent) -> None:
        """Add one event's."""
        self.samples += b64decode(event.torque)
        for name, values in event.outcomes.model_dump().items():
            self.outcomes.setdefault(name, []).extend(values)


@dataclass
class Advice:
    """The adviser's decision, when its newest sample was received (monotonic, s), and its line of the document."""

    document: dict[str, Any]
    received_s: float
    row: dict[str, Any]


@dataclass
class Turn:
    """One boundary between pieces: the request to the adviser and its result."""

    after: int
    """Pulses that are laid before it."""
    questions: int = 0
    """1: with early samples; 2: with the newest ones."""
    advice: Advice | None = None
    sent: bool = False


class Follower(Watcher):
    """One test from its first sample to its end. Each segment of its plan holds its widths."""

    log = logging.getLogger("stimrig.adaptive")
    status: AdaptiveStatus

    def __init__(self, planned: Planned, kind: Watched, adviser: Pool) -> None:
        super().__init__(planned.plan, kind)
        self.how, self.adviser = planned.how, adviser
        self.key = secrets.token_urlsafe(24)
        self._fixed = [segment.settings["pulse_width_us"] for segment in self.plan.segments or []]
        self._added: list[list[float]] = []
        self._news = News()
        self._newest: LiveEvent | None = None
        self._received_s = 0.0
        self._took_s = 0.0
        self._turn = Turn(-1)
        self._deciding: asyncio.Task[None] | None = None

    async def _listen(self) -> None:
        self._deciding = self.begin(self._begin())
        await super()._listen()

    async def _begin(self) -> None:
        await self.adviser.submit("adaptive_begin", **self.how).result

    def give_up(self, why: str) -> None:
        """As `Watcher`; the fixed plan plays on at once, without rest for somebody who would choose."""
        super().give_up(why)
        self._tasks.begin(self._release(self._turn.after))

    async def _release(self, after: int) -> None:
        with contextlib.suppress(ApiError):  # without this request the test continues after the rig's timeout
            await self.rig.ask(ExtendRequest(test_id=self.plan.test_id, key=self.key, after=after, segments=[]))

    def hear(self, event: LiveEvent) -> None:
        self._newest, self._received_s = event, self.clock.monotonic_s()
        self.status.torque_time_nm_s = event.torque_time_nms
        self._news.add(event)
        if event.laid != self._turn.after:
            self._turn = Turn(event.laid)
        turn, left_s = self._turn, self._left_s(event)
        if event.ended_by or self.status.state != self.kind.watching or turn.sent:
            return
        idle = self._deciding is None or self._deciding.done()
        early_s = max(EARLY_S, 1.5 * self._took_s + SEND_S)  # earlier on a busy machine
        least_s = LEAST_S + 2.0 / self.plan.pulse_rate_hz
        if idle and event.elapsed_s >= least_s and left_s <= (early_s, LATE_S, -1.0)[turn.questions]:
            turn.questions = 2 if left_s <= LATE_S else 1
            self._deciding = self.begin(self._decide(turn))
        elif turn.advice is not None and left_s <= SEND_S:  # the late one is not there
            self.begin(self._carry_out(turn, turn.advice))

    def _left_s(self, event: LiveEvent) -> float:
        """Return the time from now until the rig needs the next segment, s; `event`: the newest one."""
        now_s = event.elapsed_s + self.clock.monotonic_s() - self._received_s
        return event.boundary_s - AHEAD / self.plan.pulse_rate_hz - now_s

    async def _decide(self, turn: Turn) -> None:
        # the newest event: outcomes of pulses and scheduled segments must be of the same event
        event, received_s, news, self._news = self._newest, self._received_s, self._news, News()
        assert event is not None
        widths, segments = self._played_so_far(event)
        job = self.adviser.submit(
            "adaptive_advise", samples=news.samples, zero_s=event.zero_s, outcomes=news.outcomes, laid_us=widths,
            segments=segments, torque_time_nm_s=event.torque_time_nms, measured_s=event.elapsed_s,
        )  # fmt: skip
        document = await job.result
        self._took_s = self.clock.monotonic_s() - received_s
        late = turn is not self._turn or turn.sent
        advice = Advice(document, received_s, self._note(document, event, late))
        if late:
            return
        turn.advice = advice
        assert self._newest is not None
        if turn.questions == 2 or self._left_s(self._newest) <= SEND_S:
            await self._carry_out(turn, advice)

    def _note(self, document: dict[str, Any], event: LiveEvent, late: bool) -> dict[str, Any]:
        """Add the decision's line to the document and return it. It has all its keys: pages read it in threads."""
        status, known = self.status, document["knowledge"]
        # a misfit is reported as the problem, its bands are meaningless; the bands of the final decision stay
        if document["kind"] != "misfit" and not status.ended:
            status.words = document["words"]
            if known is not None:
                status.knowledge, status.least_known = known, document["least_known"]
        row = {
            "at_s": round(event.elapsed_s, 3), "kind": document["kind"], "words": document["words"],
            "segments": [segment["name"] for segment in document["segments"]],
            "expected_torque_time_nm_s": document["expected_torque_time_nm_s"],
            "answer_ms": round(1e3 * self._took_s, 1), "late": late, "refused": None, "sample_to_plan_ms": None,
            **{name: known and round(known[name], 3) for name in ("curve_percent", "step_percent")},
        }  # fmt: skip
        status.decisions.append(row)
        self.kind.publish()
        return row

    async def _carry_out(self, turn: Turn, advice: Advice) -> None:
        if turn.sent:  # the newest advice came between
            return
        turn.sent = True
        status, kind, test_id = self.status, advice.document["kind"], self.plan.test_id
        if kind == "misfit":
            self.give_up(advice.document["words"])
            return
        chosen = [SegmentPlan(**segment) for segment in advice.document["segments"]]
        before = status.state, status.ended
        if kind == "next":
            request: Any = ExtendRequest(test_id=test_id, key=self.key, after=turn.after, segments=chosen)
        else:
            request = EnoughRequest(test_id=test_id, by=SERVICE, at_once=kind == "enough")
            # before the request: samples that arrive during it are not part of this decision
            ended = "known-enough" if kind == "enough" else self._spent()
            status.state, status.ended = "ending", status.ended or ended
        self._added += (widths := [segment.settings["pulse_width_us"] for segment in chosen])
        try:
            await self.rig.ask(request)
        except ApiError as error:  # too late, or a limit: the fixed plan's next piece plays, then it decides again
            if kind != "next":
                status.state, status.ended = before
            if error.code == "rig-unreachable":  # unknown whether it was scheduled, and what plays next
                raise
            del self._added[len(self._added) - len(widths) :]
            advice.row["refused"] = error.detail
            self.log.info("not laid: %s", error.detail, extra={"test_id": test_id})
            return
        advice.row["sample_to_plan_ms"] = round(1e3 * (self.clock.monotonic_s() - advice.received_s), 1)
        self.kind.publish()

    def _spent(self) -> str:
        """Return which bound leaves no room for another piece."""
        assert self._newest is not None and self.plan.adaptive is not None
        left_s = self.plan.adaptive.max_duration_s - self._newest.boundary_s
        return "time" if left_s < SHORTEST_PIECE_S + SAFE_END_S else "torque-time"

    def _played_so_far(self, event: LiveEvent) -> tuple[list[float], list[tuple[str, int, int]]]:
        """Return the width of each scheduled pulse, and the segments."""
        rate_hz = self.plan.pulse_rate_hz
        sources: Any = {"plan": iter(self._fixed), "extension": iter(self._added)}
        widths: list[float] = []
        segments = []
        for segment in event.laid_segments:
            count = round(segment.end_s * rate_hz) - len(widths)
            # other segments are rest: the test waits or ends
            source_widths = next(sources[segment.by], []) if segment.by in sources else []
            segments.append((segment.name, len(widths), len(widths) + count))
            widths += [*source_widths, *[0.0] * count][:count]
        return widths, segments
