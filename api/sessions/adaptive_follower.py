"""Follows a test that stops itself: before each boundary asks the adviser what to play, and has the rig lay it.

The rig never waits under current. An answer that comes late costs rest. What comes far too late falls away: the fixed
plan's next piece plays, and the next boundary is decided with the longer record.
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

ASK_S, SEND_S = 0.5, 0.06
"""Before the rig decides on a boundary the adviser is asked; and so long before it an answer is to be there."""
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
        self._samples = b""
        """Samples, and the outcomes of pulses by column, since the last question."""
        self._outcomes: dict[str, list[Any]] = {}
        self._newest: LiveEvent | None = None
        self._received_s = 0.0
        self._took_s = 0.0
        self._asked_after = -1
        """Pulses that are laid before the boundary that was asked about."""
        self._deciding: asyncio.Task[None] | None = None

    def start(self) -> None:
        self._deciding = self.begin(self._begin())

    async def _begin(self) -> None:
        await self.adviser.submit("adaptive_begin", **self.how).result

    def give_up(self, why: str) -> None:
        """As `Watcher`; the fixed plan plays on at once, without rest for somebody who would choose."""
        super().give_up(why)
        self.tasks.begin(self._release(-1 if self._newest is None else self._newest.laid))

    async def _release(self, after: int) -> None:
        with contextlib.suppress(ApiError):  # without this request the test continues after the rig's timeout
            await self.rig.ask(ExtendRequest(test_id=self.plan.test_id, key=self.key, after=after, segments=[]))

    def hear(self, event: LiveEvent) -> None:
        self._newest, self._received_s = event, self.clock.monotonic_s()
        self.status.torque_time_nm_s = event.torque_time_nms
        self._samples += b64decode(event.torque)
        for name, values in event.outcomes.model_dump().items():
            self._outcomes.setdefault(name, []).extend(values)
        busy = self._deciding is not None and not self._deciding.done()
        if busy or event.ended_by or self.status.state != self.kind.watching or event.laid == self._asked_after:
            return
        rate_hz = self.plan.pulse_rate_hz
        left_s = event.boundary_s - AHEAD / rate_hz - event.elapsed_s
        early_s = max(ASK_S, 1.5 * self._took_s + SEND_S)  # earlier on a busy machine
        if event.elapsed_s >= LEAST_S + 2.0 / rate_hz and left_s <= early_s:
            self._asked_after = event.laid
            self._deciding = self.begin(self._decide())

    async def _decide(self) -> None:
        # the newest event: outcomes of pulses and scheduled segments must be of the same event
        event, received_s = self._newest, self._received_s
        assert event is not None
        samples, self._samples = self._samples, b""
        outcomes, self._outcomes = self._outcomes, {}
        self._asked_after = event.laid
        widths, segments = self._played_so_far(event)
        job = self.adviser.submit(
            "adaptive_advise", samples=samples, zero_s=event.zero_s, outcomes=outcomes, laid_us=widths,
            segments=segments, torque_time_nm_s=event.torque_time_nms, measured_s=event.elapsed_s,
        )  # fmt: skip
        document = await job.result
        self._took_s = self.clock.monotonic_s() - received_s
        row = self._note(document, event)
        if not row["late"]:
            await self._carry_out(document, row, received_s)

    def _note(self, document: dict[str, Any], event: LiveEvent) -> dict[str, Any]:
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
            "answer_ms": round(1e3 * self._took_s, 1), "late": self._newest is None or self._newest.laid != event.laid,
            "refused": None, "sample_to_plan_ms": None,
            **{name: known and round(known[name], 3) for name in ("curve_percent", "step_percent")},
        }  # fmt: skip
        status.decisions.append(row)
        self.kind.publish()
        return row

    async def _carry_out(self, document: dict[str, Any], row: dict[str, Any], received_s: float) -> None:
        status, kind, test_id = self.status, document["kind"], self.plan.test_id
        if kind == "misfit":
            self.give_up(document["words"])
            return
        chosen = [SegmentPlan(**segment) for segment in document["segments"]]
        before = status.state, status.ended
        request: Any = ExtendRequest(test_id=test_id, key=self.key, after=self._asked_after, segments=chosen)
        if kind != "next":
            request = EnoughRequest(test_id=test_id, by=SERVICE, at_once=kind == "enough")
            # before the request: samples that arrive during it are not part of this decision
            assert self._newest is not None and self.plan.adaptive is not None
            left_s = self.plan.adaptive.max_duration_s - self._newest.boundary_s
            spent = "time" if left_s < SHORTEST_PIECE_S + SAFE_END_S else "torque-time"  # no room for another piece
            ended = "known-enough" if kind == "enough" else spent
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
            row["refused"] = error.detail
            self.log.info("not laid: %s", error.detail, extra={"test_id": test_id})
            return
        row["sample_to_plan_ms"] = round(1e3 * (self.clock.monotonic_s() - received_s), 1)
        self.kind.publish()

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
