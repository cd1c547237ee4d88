"""Queue of segments to play. In an adaptive test it grows while it plays; only the test's end removes queued pulses.

The sender asks for one pulse after the other. Shortly before it reaches the end of what is laid, the fixed plan's next
segment is laid, unless a client has laid others by then. A plan may have patience with a client that is late: then a
short rest is laid first, so that no muscle waits under current. So the test never hangs, whatever a client does. Each
segment is in the journal before its first pulse can be played. If a limit of the whole test leaves no room, the test
ends well: a second without stimulation, and nothing after it.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Sequence

import numpy as np

from stimrig.rig import plan
from stimrig.rig.errors import BusyError, PlanError, RefusedError, TooLateError
from stimrig.rig.journal import Journal, Kind, LaidBlock
from stimrig.rig.limits import Limit, tightened
from stimrig.rig.messages import AHEAD, Extended, SegmentPlan
from stimrig.rig.plan import Layout, Piece, PlannedTest
from stimrig.rig.signals import LaidBy, Segment
from stimrig.rig.tasks import Tasks

MAX_EXTENSION_SEGMENTS = 8
MAX_EXTENSION_S = 30.0
MAX_CHECKED = 20
"""Extensions that are checked while the test plays towards one boundary; each takes time beside the sender."""
MAX_NAME = 60
SAFE_END = SegmentPlan(name="rest", sequence="rest", settings={})
WAIT = SegmentPlan(name="wait", sequence="rest", settings={})
WAIT_S = 0.25


class Score:
    """The pulses of one test.

    `test`, `table`: the checked plan, and the limits that hold for the whole test; `journal`: gets each segment of an
    adaptive test that is laid after the start.
    """

    def __init__(self, test: PlannedTest, table: dict[str, Limit], journal: Journal, tasks: Tasks) -> None:
        self.plan, self.adaptive, self.longest_s = test.plan, test.plan.adaptive, test.longest_s
        self.ended_by = "" if self.adaptive else "plan"
        """Why nothing more will be laid; empty: more may be."""
        self._table, self._journal = table, journal
        self._tasks, self._clock = tasks, tasks.clock
        self._checking = False
        self._patience_s = 0.0 if self.adaptive is None else self.adaptive.patience_s
        at_start = test.pieces[:1] if self.adaptive else test.pieces
        self._fixed = deque(test.pieces[len(at_start) :])
        self.queue = plan.NOTHING.add(at_start, "plan")
        self.decided = len(self.queue)
        """Pulses that are laid, without the rest behind them that only waits for a client."""
        self._reached = -1
        self._end_at: int | None = None
        self._checked = 0
        self._shut = False

    @property
    def duration_s(self) -> float:
        return len(self.queue) / self.plan.pulse_rate_hz

    def segment_at(self, time_s: float) -> str | None:
        """Name of the segment at a time on the test's clock, None outside."""
        index = int(np.floor(time_s * self.plan.pulse_rate_hz + 1e-9))
        return next((s.name for s in self.queue.segments if s.start <= index < s.end), None)

    def pulse(self, index: int, torque_time_nms: float) -> float | None:
        """Width of the next pulse, µs; None after the last. Only the sender asks, in order.

        `index`: one more than the last time; `torque_time_nms`: measured until now. Raises JournalError: what was to be
        laid could not be written.
        """
        if self.adaptive is not None:
            bound_nms = self.adaptive.max_torque_time_nms
            if not (torque_time_nms < bound_nms):
                self._end("torque_time", f"torque-time {torque_time_nms:.1f} of {bound_nms:g} N·m·s", cut=index)
            elif index + AHEAD > len(self.queue) and not self.ended_by:
                self._go_on()
        self._reached = index
        return float(self.queue.pulse_width_us[index]) if index < len(self.queue) else None

    async def extend(self, after: int, chosen: Sequence[SegmentPlan]) -> None:
        """Lay segments behind everything that is laid: all of them, or none.

        `after`: `decided` when the client did. `chosen`: empty: nothing more comes from this client, so the fixed plan
        plays on. Raises TooLateError: more was laid meanwhile, or the test is ending. BusyError: too many extensions at
        the same time, or for one boundary. PlanError, RefusedError: as for a plan. JournalError: it was not written.
        """
        self._may_grow(after)
        if not chosen:
            self._patience_s = 0.0
            return
        if self._checked >= MAX_CHECKED:
            raise BusyError(f"extend: {MAX_CHECKED} extensions were checked for this boundary; wait for the next")
        self._checked += 1
        if self._checking:
            raise BusyError("extend: another extension is being checked; send one after the other")
        self._checking = True
        try:
            built = await self._tasks.work(self._built_and_checked, self.queue, chosen)
        finally:
            self._checking = False
        self._may_grow(after)  # the test went on meanwhile
        for piece in built:
            self._append(piece, "extension")
        self._patience_s = self.adaptive.patience_s if self.adaptive else 0.0

    def enough(self, by: str, at_once: bool) -> None:
        """End well: at the next pulse, or where the segment that plays ends. A second call may only end it sooner.

        Raises PlanError: the test is not adaptive. TooLateError, JournalError: it has ended; it could not be written.
        """
        if self.adaptive is None:
            raise PlanError("enough: this test has a fixed plan; stop it, or let it play to its end")
        self._may_change()
        handed = self._reached + 1  # a segment whose first pulse is handed out to wait does not play yet
        playing = next((s.end for s in self.queue.segments if s.end >= self._reached), len(self.queue))
        self._end("enough", by, handed if at_once else max(handed, playing))

    def shut(self) -> None:
        """From now on every request is refused."""
        self._shut = True

    def progress(self, torque_time_nms: float) -> Extended:
        """Return the scheduled part of an adaptive test, and the remainder of its bounds."""
        assert self.adaptive is not None
        queue, rate_hz = self.queue, self.plan.pulse_rate_hz
        charge_uc = plan.charge_uc(queue.pulse_width_us, self.plan.profile.current_ma)
        return Extended(
            test_id=self.plan.test_id,
            laid=self.decided,
            boundary_s=self.decided / rate_hz,
            ended_by=self.ended_by,
            duration_left_s=max(0.0, self.longest_s - len(queue) / rate_hz),
            charge_left_uc=max(0.0, self._table["charge_per_test_uc"].hi - charge_uc),
            torque_time_left_nms=max(0.0, self.adaptive.max_torque_time_nms - torque_time_nms),
        )

    def _may_change(self) -> None:
        if self._shut:
            raise TooLateError(f"test {self.plan.test_id} is being ended")

    def _may_grow(self, after: int) -> None:
        self._may_change()
        if self.ended_by:
            raise TooLateError(f"test {self.plan.test_id} is ending ({self.ended_by}); nothing more is laid")
        if after != self.decided:
            raise TooLateError(f"extend.after: {after}, but {self.decided} pulses are laid; look again, then decide")

    def _built_and_checked(self, queue: Layout, chosen: Sequence[SegmentPlan]) -> tuple[Piece, ...]:
        """Behind what is laid; changes nothing, since it runs beside the sender."""
        before = len(queue)
        max_segments = min(MAX_EXTENSION_SEGMENTS, plan.MAX_SEGMENTS - len(queue.segments) - len(self._fixed) - 1)
        if not (1 <= len(chosen) <= max_segments):
            raise PlanError(f"extend.segments: {len(chosen)} segments; give at most {max(max_segments, 0)}")
        for number, segment in enumerate(chosen, start=1):
            if not (1 <= len(segment.name) <= MAX_NAME and segment.name.isprintable()):
                raise PlanError(f"extend.segments: name {number} must have 1 to {MAX_NAME} printable characters")
        longest_s = before / self.plan.pulse_rate_hz + MAX_EXTENSION_S
        table = tightened(self._table, "duration_s", longest_s, f"at most {MAX_EXTENSION_S:g} s an extension")
        built = plan.build_pieces(chosen, self.plan, table["duration_s"], before)
        plan.check_pieces(built, self.plan, self._table, queue)
        return built

    def _go_on(self) -> None:
        """Lay a rest where a client may still choose, else the fixed plan's next segment, or end."""
        if self._patience_s > 0:
            piece = Piece(WAIT, np.zeros(max(1, round(WAIT_S * self.plan.pulse_rate_hz))), jumps=False)
            self._patience_s -= len(piece.pulse_width_us) / self.plan.pulse_rate_hz
            with contextlib.suppress(RefusedError):  # no room for it: nor, perhaps, for the fixed plan's next segment
                plan.check_pieces([piece], self.plan, self._table, self.queue)
                self._append(piece, "wait")
                return
        if not self._fixed:
            self._end("plan", "the fixed plan is played", len(self.queue))
            return
        piece = self._fixed.popleft()
        try:
            plan.check_pieces([piece], self.plan, self._table, self.queue)
        except RefusedError as error:
            self._end("limit", f"next of the fixed plan: {error}", len(self.queue))
        else:
            self._append(piece, "plan")

    def _end(self, by: str, reason: str, cut: int) -> None:
        """Keep what is laid before pulse `cut`, and rest after it; nothing if the test rests by then anyway."""
        if self._end_at is not None and cut >= self._end_at:
            return
        event = {"event": "ended", "by": by, "reason": reason, "index": cut, "time_s": self._clock.now_s()}
        self._journal.append_json(Kind.EVENT, event)
        remaining = self.queue.cut(cut)
        missing = plan.safe_end(remaining.pulse_width_us, self.plan.pulse_rate_hz)
        if missing or len(remaining) < len(self.queue):
            self._append(Piece(SAFE_END, np.zeros(missing), jumps=False), "end", remaining)
        self.ended_by, self._end_at = by, len(remaining)

    def _append(self, piece: Piece, by: LaidBy, before: Layout | None = None) -> None:
        """Write a piece to the journal, then show it to the sender."""
        before = self.queue if before is None else before
        following = before.add([piece], by)
        block = LaidBlock(
            Segment(piece.of.name, len(before), len(following), by),
            piece.of.sequence,
            piece.of.settings,
            self._clock.now_s(),
            piece.pulse_width_us,
        )
        self._journal.append(Kind.EXTENSION, block.to_bytes())
        self.queue, self._checked = following, 0
        if by != "wait":
            self.decided = len(following)
