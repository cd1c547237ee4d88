"""A test from the request to the model: intent in the database, command to the rig, recording, identification."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.clock import Clock, asked_s
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.logs import current_test
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.places import site_of
from stimrig.api.models.registry import Versions
from stimrig.api.sessions import document
from stimrig.api.sessions.adaptive_plan import ADAPTIVE, Planned
from stimrig.api.sessions.adaptive_tests import AdaptiveTests
from stimrig.api.sessions.following import Follower
from stimrig.api.sessions.joint_plan import KINDS
from stimrig.api.sessions.joint_tests import JointTests
from stimrig.api.sessions.lifecycle import Lifecycle
from stimrig.api.sessions.limits import limits_of
from stimrig.api.sessions.live import Hub
from stimrig.api.sessions.refusals import (
    Current,
    busy,
    not_what_was_seen,
    other_than,
    refuse_archived,
    rests_of,
    right_ended,
)
from stimrig.api.sessions.requests import TestIn
from stimrig.api.sessions.rig_client import AnyEvent, RigClient
from stimrig.api.sessions.trials import SEQUENCE, Trials
from stimrig.api.store import Store, audit, seen
from stimrig.api.store.holds import LIMITS_TURN
from stimrig.api.store.tables import AuditEntry, Participant, Test, Token
from stimrig.api.workers.adviser import Adviser
from stimrig.api.workers.pool import Pool
from stimrig.rig.messages import (
    EnoughRequest,
    Extended,
    FinishedEvent,
    LiveEvent,
    PreviewRequest,
    RecruitmentTable,
    SegmentPlan,
    StartRequest,
    Status,
    StopEvidence,
    StopRequest,
    TestPlan,
    WithdrawRequest,
)

log = logging.getLogger("stimrig.trials")
NOT_CONFIRMED = "The stop is not confirmed"
HALTED = ("latched", "uncertain", "disconnected")
START_S = 10.0
"""From the request to the command to the rig: nobody waits with a hand on the button for longer."""
ANSWER_S = 15.0
"""So long the rig may take to answer a start."""
PREVIEW_S = 35.0
"""More than the rig takes for one before it says that the computer is too busy."""
ENDING_S = 2.0
"""So long a start waits for a test whose end has been heard."""
MISSED_POLLS = 3
"""After so many states that don't name the test, its end was lost: it comes within milliseconds of the state."""
NOTE_S = 0.3
"""So long the answer to a stop waits for its entry in the audit trail; the entry is made all the same."""
EMERGENCY = "Use the stimulator's own emergency switch now."
LOOK_AGAIN_S = 0.25
"""How often it is looked whether a test may still be played: another service's changes are seen so late at most."""


def same(confirmed: dict[str, Any], preview: dict[str, Any]) -> bool:
    """Whether the rig would play what was shown; the torque it is estimated to give may be known better by now."""
    return {**confirmed, **preview, "torque_time_nms": None} == {**confirmed, "torque_time_nms": None}


class Runner:
    """Starts tests, one at a time, and follows each to its model."""

    def __init__(
        self, store: Store, clock: Clock, rig: RigClient, pool: Pool, versions: Versions, analyses: Analyses,
        adviser: Adviser, trials: Trials, recordings_dir: Path, follower: Follower,
    ) -> None:  # fmt: skip
        self.store, self.clock, self.rig, self.versions, self.pool = store, clock, rig, versions, pool
        self.hub = Hub(clock)
        self.adaptive = AdaptiveTests(clock, rig, versions, adviser, self.hub.send)
        self.joint = JointTests(clock, rig, versions, self.hub.send)
        self.trials, self.follower = trials, follower
        self.current: Current | None = None
        self.lifecycle = Lifecycle(
            store,
            clock,
            rig,
            pool,
            versions,
            analyses,
            self.adaptive,
            self.joint,
            recordings_dir,
            follower,
            self.announce,
        )
        self._halted_s = -math.inf
        self._notes = ThreadPoolExecutor(2, "notes-of-stops")
        self._telling = ThreadPoolExecutor(1, "tells-how-tests-stand")
        self._tasks: set[asyncio.Task[None]] = set()
        self._watching: asyncio.Task[None] | None = None
        rig.listeners.append(self._on_event)
        rig.link_listeners.append(self._on_link)
        rig.poll_listeners.append(self._on_poll)

    # ---- start and stop -------------------------------------------------------------------------------------

    async def start(
        self, body: TestIn, by: str, confirmed: dict[str, Any] | None = None, holder: str = ""
    ) -> Test:  # fmt: skip
        """Begin a test.

        Parameters
        ----------
        body : TestIn
            The test.
        by : str
            Who answers for it.
        confirmed : dict, optional
            The preview that a person has said yes to; None: a program's request, which nobody was shown.
        holder : str
            Hash of the token by whose right it is begun.

        Raises
        ------
        ApiError
            404 no such participant; 409 another test runs, the holder named; 409 it would not be what was seen, or a
            stop came since it was asked for; 503 that was too long ago; what the rig refuses.
        """
        if seen.shown.get() is None:  # then it rests on what is read from here on
            seen.shown.set(await asyncio.to_thread(self.store.seen, self.clock))
        tokens = await asyncio.to_thread(self._tokens, holder)
        await self._let_end()
        self.refuse_second()
        if body.kind == ADAPTIVE:  # what it can reach is computed now, and not while others wait, and then remembered
            await self._planned(body, await self._participant(body))
        async with self.follower.rig_turn():
            self.refuse_second()
            await self._refuse_beside_another_service()
            participant = await self._participant(body)
            return await self._start(body, participant, by, confirmed, tokens)

    def plays(self, test_id: str | None) -> bool:
        """Whether the rig plays this test now."""
        current = self.current
        return current is not None and current.test_id == test_id and current.started and not current.ending

    async def _let_end(self) -> None:
        """A test is seen to be done a moment before the rig is let go: who starts the next one then is not refused."""
        if self.current is not None and self.current.ending:
            with suppress(TimeoutError):
                await asyncio.wait_for(self.current.let_go.wait(), ENDING_S)

    def refuse_second(self) -> None:
        """409 while a test runs, its holder named."""
        if self.current is not None:
            raise busy(self.current)

    async def _refuse_beside_another_service(self) -> None:
        row = await asyncio.to_thread(self.follower.played_by_another)
        if row is not None:
            raise busy(Current(row.id, row.participant, row.requested_by))

    async def _participant(self, body: TestIn) -> Participant:
        participant = await asyncio.to_thread(self.store.get, Participant, body.participant)
        if participant is None:
            raise NotFoundError("participant", body.participant, "POST /v1/participants makes one.")
        refuse_archived(participant)
        return participant

    async def _start(
        self, body: TestIn, participant: Participant, by: str, confirmed: dict[str, Any] | None,
        tokens: list[str],
    ) -> Test:  # fmt: skip
        rests_on = rests_of(body.participant, body.kind)
        await asyncio.to_thread(self.store.refuse_changed, *rests_on)  # then the preview may differ for no other reason
        planned = await self._planned(body, participant)
        plan = planned.plan
        if body.joins is not None:
            await asyncio.to_thread(self._check_joins, body)
        until_utc = await asyncio.to_thread(self._until_utc, tokens)
        current = self.current = Current(
            plan.test_id, plan.participant, by, plan.kind, tokens=tokens, until_utc=until_utc
        )
        current_test.set(plan.test_id)
        self.pool.cancel_background()
        try:
            preview = await self._previewed(plan)
            if confirmed is not None and not same(confirmed, preview):
                raise not_what_was_seen()
            row = await asyncio.to_thread(self._write_intent, planned, preview, current, body, participant)
            self.hub.begin(plan.test_id)
            await self._command(planned, current)
            current.started = True
            self._keep(self._look_again_and_again(current))
        except BaseException:
            self.current = None
            self._leave()
            raise
        try:
            return await asyncio.to_thread(self.lifecycle.update, row.id, state="running")
        except Exception:  # who asked is told that it failed: then nothing of it plays on
            await self._stop_quietly(f"start of {plan.test_id} could not be written down")
            raise

    async def _command(self, planned: Planned, current: Current) -> None:
        plan = planned.plan
        try:
            async with self.follower.holds.turn(LIMITS_TURN):
                if changed := current.overtaken or await asyncio.to_thread(self._overtaking, current):
                    raise seen.overtaken(changed)
                if self._is_over(current):
                    raise right_ended()
                self._refuse_overtaken(asked_s.get(self.clock.monotonic_s()))  # from here to the command nothing waits
                key = self.adaptive.begin(planned) or self.joint.begin(planned)
                await self.rig.ask(StartRequest(plan=plan, key=key), timeout_s=ANSWER_S)
        except ApiError as error:
            if error.code == "rig-unreachable":  # it may have heard us all the same
                await self._stop_quietly(f"start of {plan.test_id} was not answered")
            await asyncio.to_thread(
                self.lifecycle.update, plan.test_id, state="refused", reason=error.detail or error.title
            )
            status = self.rig.status
            if error.code == "rig-busy" and status is not None:
                error.extra["holder"] = {"test_id": status.test_id, "participant": status.participant}
            raise
        except Exception as error:  # whatever it was: no test stays open that never began
            await self._stop_quietly(f"start of {plan.test_id} failed")
            await asyncio.to_thread(self.lifecycle.fail, plan.test_id, error)
            raise

    def _refuse_overtaken(self, since_s: float) -> None:
        """A start that a stop has overtaken, or whose asker has long given up, is not played."""
        if self._halted_s >= since_s:
            detail = "Nothing was sent. Check the participant and the rig, re-arm the rig, and start again."
            raise ApiError(409, "stopped-meanwhile", "The start was cancelled by a stop", detail)
        if not (self.clock.monotonic_s() - since_s <= START_S):
            detail = f"It could not begin within {START_S:g} s. Nothing was sent. Start again."
            raise ApiError(503, "too-late", "The start took too long", detail)

    # ---- whether it may still be played ---------------------------------------------------------------------

    def _overtaking(self, current: Current) -> list[AuditEntry]:
        """What was changed since its intent was written, with which it would not have been begun."""
        with self.store.read() as session:
            if current.since is None and current.started:  # it plays although this service was restarted
                current.since = seen.newest(session, "", seen.of(current.test_id, "start test"))
                current.until_utc = self._until_utc(current.tokens)
            return [] if current.since is None else seen.since(session, current.since, *current.rests_on)

    async def look_again(self) -> None:
        """Withdraw the test if what it rests on was changed: called before each change is answered.

        A test that has not begun plays no pulse; a controller's trial whose right has ended ends at once. Where the rig
        does not take that, it is stopped, and asked again.
        """
        current = self.current
        if current is None:
            return
        async with current.looking:
            over = self._is_over(current) and not current.over  # known here, also where the store cannot be read
            changed = [] if over else await asyncio.to_thread(self._overtaking, current)
            if not changed and not over:
                return
            current.overtaken = changed or current.overtaken
            begun = over or (current.kind == SEQUENCE and any(entry.action in seen.RIGHTS for entry in changed))
            what = changed[-1].action if changed else "its right ended"
            reason = f"{what}, after this test was asked for"
            try:
                await self.rig.ask(WithdrawRequest(test_id=current.test_id, reason=reason, begun=begun))
            except ApiError as error:
                log.error("%s could not be withdrawn: %s", current.test_id, error)
                await self._stop_quietly(f"{current.test_id} could not be withdrawn: {reason}")
            else:
                current.since = seen.at(changed[-1], "") if changed else current.since
                current.over |= over

    def _is_over(self, current: Current) -> bool:
        """Whether the right to it has ended by itself."""
        return current.until_utc is not None and current.until_utc <= self.clock.utc()

    def _until_utc(self, tokens: list[str]) -> str | None:
        """When the key ends by whose right a test is played, with its maker's; a person's may end before the test."""
        rows = [row for token in tokens if (row := self.store.get(Token, token)) is not None]
        by_key = any(row.participant for row in rows)
        return min((row.expires_utc for row in rows if by_key and row.expires_utc), default=None)

    def _tokens(self, holder: str) -> list[str]:
        """Hashes of the tokens by whose right a test is played: the asker's, and that of who made a key."""
        row: Token | None = self.store.get(Token, holder) if holder else None
        return [token for token in (holder, row.made_by if row else None) if token]

    async def _look_again_and_again(self, current: Current) -> None:
        """Other services change things, too."""
        while self.current is current and not current.ending:
            await asyncio.sleep(LOOK_AGAIN_S)
            try:
                await self.look_again()
            except Exception:
                log.exception("whether %s may still be played could not be seen", current.test_id)

    async def _stop_quietly(self, reason: str) -> None:
        try:
            await self.rig.request(StopRequest(reason=reason, by="service"))
        except ApiError as error:
            log.warning("stop after a failed start: %s", error)

    async def _planned(self, body: TestIn, participant: Participant) -> Planned:
        segments = None
        if body.segments is not None:
            segments = [SegmentPlan(**segment.model_dump()) for segment in body.segments]
        plan = TestPlan(
            test_id=self._new_id(),
            participant=participant.code,
            kind=body.kind,
            segments=segments,
            **({} if body.protocol is None else {"protocol": body.protocol}),
            pulse_rate_hz=body.pulse_rate_hz,
            **limits_of(body, participant.profile),
        )
        if body.kind in KINDS:
            return await self.joint.planned(body, plan, PREVIEW_S)
        if body.angle is not None:
            plan = self.joint.watched(plan, body.angle)
        return await self.adaptive.planned(body, plan, PREVIEW_S)

    async def joint_overview(self, participant: Participant) -> dict[str, Any]:
        """What is open of today's guided tests of a joint. Raises ApiError where the rig cannot be asked."""
        body = TestIn(participant=participant.code)
        limits = limits_of(body, participant.profile)
        plan = TestPlan(test_id=self._new_id(), participant=participant.code, **limits)
        return await self.joint.overview(plan, PREVIEW_S)

    def _check_joins(self, body: TestIn) -> None:
        """The model whose recording the new one is to be joined to is the participant's own."""
        model = self.versions.get(str(body.joins))
        if model.participant != body.participant:
            detail = f"{model.id} is a model of {model.participant}, the test is for {body.participant}."
            raise ApiError(422, "other-participant", "The model is another participant's", detail)

    def _new_id(self) -> str:
        stamp = self.clock.utc()[:19].replace("-", "").replace(":", "")
        return f"T{stamp}-{secrets.token_hex(3)}"

    def _write_intent(
        self, planned: Planned, preview: dict[str, Any], current: Current, body: TestIn, participant: Participant
    ) -> Test:
        now, plan, by = self.clock.utc(), planned.plan, current.by
        row = Test(id=plan.test_id, participant=plan.participant, kind=plan.kind, state="requested")
        kept: dict[str, Any] = {
            "joins": body.joins,
            **dict(zip(("side", "muscle", "placement"), site_of(participant), strict=True)),
            "tokens": current.tokens,
            **planned.kept(),
            **self.trials.kept(body, len(preview["pulse_width_us"])),
        }
        row.plan, row.summary, row.reason = {**plan.model_dump(), "preview": preview, **kept}, {}, ""
        row.requested_by, row.requested_utc, row.ran_by = by, now, other_than(by, body.ran_by)
        self.follower.mark(row)
        dose = {name: preview.get(name) for name in ("duration_s", "charge_uc", "torque_time_nms")}
        with self.store.write() as session:
            seen.check(session, *rests_of(plan.participant, plan.kind))
            if any((token := session.get(Token, each)) is None or token.revoked for each in current.tokens):
                raise right_ended()
            session.add(row)
            said = {"participant": plan.participant, "kind": plan.kind, "shown": dose}
            audit.write(session, now, by, "start test", plan.test_id, **said)
            current.since = seen.newest(session, "")
        log.info("test requested, kind %s", plan.kind, extra={"test_id": plan.test_id})
        return row

    async def preview(self, body: TestIn) -> dict[str, Any]:
        """A test's duration, dose and pulse widths; nothing is played."""
        planned = await self._planned(body, await self._participant(body))
        return {**await self._previewed(planned.plan), **planned.kept()}

    async def _previewed(self, plan: TestPlan) -> dict[str, Any]:
        curve = await asyncio.to_thread(self._recruitment, plan.participant)
        return await self.rig.ask(PreviewRequest(plan=plan, recruitment=curve), timeout_s=PREVIEW_S)

    def _recruitment(self, participant: str) -> RecruitmentTable | None:
        """The approved model's recruitment curve, to estimate the torque-time of a plan with."""
        curve = self.versions.recruitment(participant)
        return None if curve is None else RecruitmentTable(**curve)

    async def stop(self, reason: str, by: str) -> StopEvidence:
        """Stop the rig; the audit entry comes after, so that nothing delays the command.

        Raises
        ------
        ApiError
            503: the rig cannot be reached, or it could not confirm that stimulation has stopped.
        """
        self._halted_s = self.clock.monotonic_s()
        subject = self.current.test_id if self.current else "rig"
        try:
            request = StopRequest(reason=reason or "stop pressed", by=by)
            evidence = await self.rig.ask_for(StopEvidence, request, timeout_s=8.0)
        except ApiError as error:
            await self._note(by, "stop failed", subject, detail=error.detail)
            error.title, error.detail = NOT_CONFIRMED, f"{EMERGENCY} {error.title}: {error.detail}"
            raise
        await self._note(by, "stop", subject, reason=reason, confirmed=evidence.confirmed)
        if not evidence.confirmed:
            detail = f"{EMERGENCY} The rig says: {evidence.detail}"
            raise ApiError(503, "stop-not-confirmed", NOT_CONFIRMED, detail, evidence=evidence.model_dump())
        return evidence

    async def enough(self, row: Test, by: str) -> Extended:
        """End a running test that may be ended early well: enough is known, was seen, or was borne.

        Raises
        ------
        ApiError
            409: it does not run, or is ending; 422: it has a fixed plan.
        """
        found = await self.rig.ask_for(Extended, EnoughRequest(test_id=row.id, by=by, at_once=True))
        self.adaptive.said_enough(row.id)
        self.joint.said_enough(row.id)
        return found

    async def _note(self, by: str, action: str, subject: str, **detail: Any) -> None:
        """Write a stop down; a database that is slow or gone does not keep its answer back."""

        def write() -> None:
            try:
                with self.store.write() as session:
                    audit.write(session, self.clock.utc(), by, action, subject, **detail)
            except SQLAlchemyError:
                log.exception("%s by %s could not be written into the audit trail", action, by)

        noted = asyncio.get_running_loop().run_in_executor(self._notes, write)  # threads that nothing else can fill
        await asyncio.wait({noted}, timeout=NOTE_S)

    # ---- what the rig says ----------------------------------------------------------------------------------

    def _on_event(self, event: AnyEvent) -> None:
        if isinstance(event, LiveEvent):
            if self.current is None and event.test_id not in (None, self.hub.test_id):
                self.hub.begin(event.test_id)  # another service began it
            self.hub.live(event)
        elif isinstance(event, FinishedEvent):
            self._follow(event.test_id, self._finish(event))
        else:
            if event.status.state in HALTED:
                self._halted_s = self.clock.monotonic_s()
            self.hub.send({"type": "state", "rig": event.status.model_dump(exclude={"finished"})})

    def _on_link(self, connected: bool) -> None:
        self.hub.send({"type": "link", "connected": connected})
        current, status = self.current, self.rig.status
        if not connected or status is None or current is None or not current.started:
            return  # a start under way learns by itself what became of it
        if not current.ending and status.test_id != current.test_id:
            current.ending = True
            self._follow(current.test_id, self._recover(current.test_id, "the rig's process ended during the test"))

    def _on_poll(self, status: Status) -> None:
        """A test whose end was lost on the way must not hold the rig for ever."""
        current = self.current
        if current is None or not current.started or current.ending:
            return
        current.missed = 0 if status.test_id == current.test_id else current.missed + 1
        if current.missed >= MISSED_POLLS:
            current.ending = True
            self._follow(
                current.test_id,
                self._recover(current.test_id, f"the rig is {status.state} and no longer plays this test"),
            )

    def _follow(self, test_id: str, work: Coroutine[Any, Any, None]) -> None:
        """Do what leads a test to its last state, in the background and under the one guard."""
        self._keep(self._guarded(test_id, work))

    def _keep(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("the end of a test could not be written down", exc_info=error)

    async def _guarded(self, test_id: str, work: Coroutine[Any, Any, None]) -> None:
        """Follow a test to its last state: an unexpected error is told as its reason, and the rig is let go.

        Where the state cannot be written either, the next start of the service takes the test up.
        """
        current_test.set(test_id)
        try:
            await work
        except Exception as error:
            log.exception("the test could not be taken over", extra={"test_id": test_id})
            await asyncio.to_thread(self.lifecycle.fail, test_id, error)
        finally:
            self._release(test_id)
            self.announce(test_id)

    async def _finish(self, event: FinishedEvent) -> None:
        """Take over a finished test: store the recording, identify, store the model."""
        if self.current is not None and self.current.test_id == event.test_id:
            self.current.ending = True
        with self.trials.ending():
            row = await asyncio.to_thread(self.lifecycle.take_recording, event)
            if row is None:
                return
            self.announce(row.id)
            if row.kind == SEQUENCE and row.state == "completed":
                self._release(event.test_id)
                await self.trials.follow(row.id, event.last_sample_unix_s)
        if row.state == "identifying":
            self._release(event.test_id)
            await self.lifecycle.identify(row.id, event.last_sample_unix_s)

    def _release(self, test_id: str) -> None:
        """The rig is free again; the identification goes on beside it."""
        if self.current is not None and self.current.test_id == test_id:
            self.current.let_go.set()
            self.current = None
            self._leave()

    def _leave(self) -> None:
        self.adaptive.leave()
        self.joint.leave()

    # ---- after a restart ------------------------------------------------------------------------------------

    async def resume(self) -> None:
        """Take up what a restart of the service left open, and from now on what another service leaves."""
        self.trials.resume()
        self._take_up(await asyncio.to_thread(self.follower.left))
        self._watching = asyncio.create_task(self.follower.watch(self._take_up, self.trials.resume))

    def _take_up(self, left: list[Test]) -> None:
        for row in left:
            status = self.rig.status
            if (
                status is not None
                and status.test_id == row.id
                and status.state not in ("ready", "latched", "uncertain")
            ):
                tokens = row.plan.get("tokens") or []
                current = Current(row.id, row.participant, row.requested_by, row.kind, True, tokens=tokens)
                self.current = current
                self.hub.begin(row.id)
                self._keep(self._look_again_and_again(current))
            else:
                self._follow(row.id, self._recover(row.id, "the service was restarted during the test"))

    async def _recover(self, test_id: str, why: str) -> None:
        """A test whose end was not heard: its recording, if the rig sealed one, is adopted."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)
        if row.recording_id is not None:
            await self.lifecycle.identify(test_id)
        else:
            await self._finish(await self.lifecycle.missed_end(test_id, why))

    # ---- what clients see -----------------------------------------------------------------------------------

    def announce(self, test_id: str) -> None:
        """Tell the listeners of the live channel how the test stands; in the order in which it is called."""
        read = asyncio.get_running_loop().run_in_executor(self._telling, self._told, test_id)
        read.add_done_callback(self._tell)

    def _told(self, test_id: str) -> dict[str, Any] | None:
        row = self.store.get(Test, test_id)
        return None if row is None else self.document(row)

    def _tell(self, read: asyncio.Future[dict[str, Any] | None]) -> None:
        if read.cancelled():
            return
        if (error := read.exception()) is not None:
            log.error("how a test stands could not be read", exc_info=error)
        elif (document := read.result()) is not None:
            self.hub.send({"type": "test", "test": document})

    def document(self, row: Test) -> dict[str, Any]:
        """A test as clients see it."""
        return document.of(row, self.hub, self.lifecycle, self.adaptive, self.joint)

    async def close(self) -> None:
        """Leave what runs to the next start of the service."""
        tasks = [*self._tasks, *([self._watching] if self._watching else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self.adaptive.close()
        await self.joint.close()
        await self.trials.close()
        await asyncio.to_thread(self._notes.shutdown)
        await asyncio.to_thread(self._telling.shutdown)
