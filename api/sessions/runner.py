"""A test from the request to the model: intent in the database, command to the rig, recording, identification."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import time
from collections.abc import Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from stimrig.api.clock import Clock, request_received_s
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.logs import current_test
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.places import in_words, site_of
from stimrig.api.models.registry import Versions
from stimrig.api.sessions.adaptive import ADAPTIVE, AdaptiveTests
from stimrig.api.sessions.joint import JointTests
from stimrig.api.sessions.kinds import Kind, Kinds, Planned
from stimrig.api.sessions.lifecycle import Lifecycle
from stimrig.api.sessions.live import Hub
from stimrig.api.sessions.playing import (
    Current,
    Playing,
    Requester,
    may_play,
    other_than,
    refuse_archived,
    right_ended,
)
from stimrig.api.sessions.previews import Preview, Previews, refuse_changed
from stimrig.api.sessions.requests import TestIn, limits_of
from stimrig.api.sessions.rig_client import AnyEvent, RigClient
from stimrig.api.sessions.stop_counter import StopCounter
from stimrig.api.sessions.trials import Trials
from stimrig.api.store import Store, audit, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import OPEN_STATES, Participant, Test, Token
from stimrig.rig import messages, requests

log = logging.getLogger("stimrig.trials")
NOT_CONFIRMED = "The stop is not confirmed"
HALTED = ("latched", "uncertain", "disconnected")
START_S = 10.0
"""From the request to the command to the rig: nobody waits with a hand on the button for longer."""
ANSWER_S = 15.0
"""So long the rig may take to answer a start."""
PREVIEW_S = 35.0
"""More than the rig takes for one before it says that the computer is too busy."""
MISSED_POLLS = 3
"""After so many states that don't name the test, its end was lost: it comes within milliseconds of the state."""
NOTE_S = 0.3
NOTE_AGAIN_S = (0.5, 1.0, 2.0, 4.0, 8.0, 0.0)  # a database may restart while a stop is written down
"""So long the answer to a stop waits for its entry in the audit trail; the entry is made all the same."""
EMERGENCY = "Use the stimulator's own emergency switch now."


def same(confirmed: dict[str, Any], preview: dict[str, Any]) -> bool:
    """Return whether the rig would play the previewed plan; the estimated torque may differ."""
    return {**confirmed, **preview, "torque_time_nms": None} == {**confirmed, "torque_time_nms": None}


class Runner(Playing):
    """Starts tests, one at a time, and follows each to its model."""

    def __init__(
        self, store: Store, clock: Clock, rig: RigClient, pool: Pool, versions: Versions, analyses: Analyses,
        adviser: Pool, trials: Trials, recordings_dir: Path, limits_lock: asyncio.Lock,
    ) -> None:  # fmt: skip
        super().__init__(store, clock, rig)
        self.versions, self.pool, self.trials, self.limits_lock = versions, pool, trials, limits_lock
        self.previews = Previews(clock)
        self.start_lock = asyncio.Lock()
        """Serialises the preparation of starts."""
        self.hub, self.counted = Hub(clock), StopCounter()
        self.adaptive = AdaptiveTests(clock, rig, versions, adviser, self.hub.send)
        self.joint = JointTests(clock, rig, versions, self.hub.send)
        self.kinds = Kinds(Kind(rig), trials, self.adaptive, self.joint)
        self.lifecycle = Lifecycle(
            store, clock, rig, pool, versions, analyses, self.kinds, recordings_dir, self.announce
        )
        self._halted_s = -math.inf
        self._notes = ThreadPoolExecutor(2, "notes-of-stops")
        self._telling = ThreadPoolExecutor(1, "tells-how-tests-stand")
        self._tasks = Tasks(log)
        rig.listeners.append(self._on_event)
        rig.link_listeners.append(self._on_link)
        rig.poll_listeners.append(self._on_poll)

    # ---- start and stop -------------------------------------------------------------------------------------

    async def start(self, body: TestIn, requester: Requester) -> Test:
        """Begin a test; with `plan_hash` the previewed one. Started from it twice, the first test is returned.

        Raises ApiError: 404 no such participant; 412 it was changed; 409 another test runs, the holder named; 409 it
        would not be what was seen, or a stop came since it was asked for; 410 no such preview; 503 that was too long
        ago; what the rig refuses.
        """
        if body.plan_hash is None:
            return await self._begin(body, requester)
        preview = self.previews.find(body.participant, body.plan_hash)
        async with preview.starting:
            if preview.test_id is None:
                return await self._begin(preview.body, requester, preview)
        return await asyncio.to_thread(self.store.get, Test, preview.test_id)

    async def _begin(self, body: TestIn, requester: Requester, preview: Preview | None = None) -> Test:
        await self.let_end()
        self.refuse_second()
        # computes and caches the reach of an adaptive test before the lock, so that other starts do not wait
        if body.kind == ADAPTIVE and preview is None:
            await self._planned(body, await self._participant(body))
        async with self.start_lock:
            self.refuse_second()
            participant = await self._participant(body)
            return await self._start(body, participant, requester, preview)

    def _check(self, code: str, tags: Tags | None) -> None:
        with self.store.read() as session:
            row = session.get(Participant, code)
            assert row is not None
            locking.check(session, row, tags)

    async def _participant(self, body: TestIn) -> Participant:
        participant = await asyncio.to_thread(self.store.get, Participant, body.participant)
        if participant is None:
            raise NotFoundError("participant", body.participant, "POST /v1/participants makes one.")
        refuse_archived(participant)
        return participant

    async def _start(
        self, body: TestIn, participant: Participant, requester: Requester, seen_preview: Preview | None
    ) -> Test:
        # rules out a changed participant before the previews are compared
        await asyncio.to_thread(self._check, body.participant, requester.tags)
        if seen_preview is None:
            planned = await self._planned(body, participant)
        else:
            refuse_changed(seen_preview, participant)
            planned = replace(
                seen_preview.planned, plan=seen_preview.planned.plan.model_copy(update={"test_id": self._new_id()})
            )
        plan = planned.plan
        tokens = await asyncio.to_thread(self.tokens_of, requester.token)
        until_utc = await asyncio.to_thread(self.until_utc, tokens)
        current = self.current = Current(
            plan.test_id, plan.participant, requester.name, plan.kind, tokens=tokens, until_utc=until_utc
        )
        current_test.set(plan.test_id)
        self.pool.cancel_background()
        try:
            preview = await self._previewed(plan)
            if seen_preview is not None and not same(seen_preview.answer, preview):
                raise not_what_was_seen()
            row = await asyncio.to_thread(self._write_intent, planned, preview, current, body, participant, requester)
            self.hub.begin(plan.test_id)
            await self._command(planned, current)
            current.started = True
            if seen_preview is not None:
                seen_preview.test_id = plan.test_id
            self._tasks.begin(self.look_again_and_again(current))
        except BaseException:
            self.current = None
            self._unwatch_all()
            raise
        try:
            return await asyncio.to_thread(self.lifecycle.update, row.id, state="running")
        except Exception:  # the requester gets an error, so the test must not keep playing
            await self.stop_quietly(f"start of {plan.test_id} could not be written down")
            raise

    async def _command(self, planned: Planned, current: Current) -> None:
        plan = planned.plan
        try:
            async with self.limits_lock:
                if current.over or self.is_over(current):
                    raise right_ended()
                version, changes, lost = await asyncio.to_thread(self.find_changes, current)
                if lost:
                    raise right_ended()
                if current.changes or version != current.version:
                    raise locking.ChangedError(version or 0, current.changes or changes)
                # no await between here and the command
                self._refuse_overtaken(request_received_s.get(self.clock.monotonic_s()))
                key = self.kinds[plan.kind].begin(planned)
                await self.rig.ask(requests.StartRequest(plan=plan, key=key), timeout_s=ANSWER_S)
        except ApiError as error:
            if error.code == "rig-unreachable":  # the rig may have received the command
                await self.stop_quietly(f"start of {plan.test_id} was not answered")
            await asyncio.to_thread(
                self.lifecycle.update, plan.test_id, state="refused", reason=error.detail or error.title
            )
            status = self.rig.status
            if error.code == "rig-busy" and status is not None:
                error.extra["holder"] = {"test_id": status.test_id, "participant": status.participant}
            raise
        except Exception as error:  # any error: a test that never began must not stay open
            await self.stop_quietly(f"start of {plan.test_id} failed")
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

    async def _planned(self, body: TestIn, participant: Participant) -> Planned:
        segments = None
        if body.segments is not None:
            segments = [messages.SegmentPlan(**segment.model_dump()) for segment in body.segments]
        plan = messages.TestPlan(
            test_id=self._new_id(),
            **{name: getattr(body, name) for name in messages.LABELS},
            segments=segments,
            **({} if body.protocol is None else {"protocol": body.protocol}),
            pulse_rate_hz=body.pulse_rate_hz,
            **limits_of(body, participant.profile),
        )
        if body.joins is not None:
            await asyncio.to_thread(self._check_joins, body.joins, participant, plan)
        return await self.kinds[body.kind].planned(body, plan, PREVIEW_S)

    async def joint_overview(self, participant: Participant) -> dict[str, Any]:
        """Return today's open guided tests of a joint. Raises ApiError: the rig does not answer."""
        body = TestIn(participant=participant.code)
        limits = limits_of(body, participant.profile)
        plan = messages.TestPlan(test_id=self._new_id(), participant=participant.code, **limits)
        return await self.joint.overview(plan, PREVIEW_S)

    def _check_joins(self, joins: str, participant: Participant, plan: messages.TestPlan) -> None:
        """The model whose recording the new one is to be joined to is the participant's own, and of the same place."""
        model = self.versions.get(joins)
        if model.participant != participant.code:
            detail = f"{model.id} is a model of {model.participant}, the test is for {participant.code}."
            raise ApiError(422, "other-participant", "The model is another participant's", detail)
        there, before_ma = self.versions.measured_at(model)
        here, now_ma = site_of(participant), plan.profile.current_ma
        title = "The recordings could not be joined"
        if there not in (None, here):
            detail = f"The model was measured at {in_words(there)}, this test is at {in_words(here)}."
            raise ApiError(409, "other-site", title, detail)
        if before_ma not in (None, now_ma):
            detail = f"The model was measured with {before_ma:g} mA, this test is with {now_ma:g} mA."
            raise ApiError(409, "other-current", title, detail)

    def _new_id(self) -> str:
        stamp = self.clock.utc()[:19].replace("-", "").replace(":", "")
        return f"T{stamp}-{secrets.token_hex(3)}"

    def _write_intent(
        self, planned: Planned, preview: dict[str, Any], current: Current, body: TestIn, participant: Participant,
        requester: Requester,
    ) -> Test:  # fmt: skip
        now, plan, by = self.clock.utc(), planned.plan, requester.name
        stored_plan: dict[str, Any] = {
            **plan.model_dump(),
            "preview": preview,
            "joins": body.joins,
            **dict(zip(("side", "muscle", "placement"), site_of(participant), strict=True)),
            "tokens": current.tokens,
            **planned.extra,
            **self.kinds[body.kind].stored_fields(body, len(preview["pulse_width_us"])),
        }
        dose = {name: preview.get(name) for name in ("duration_s", "charge_uc", "torque_time_nms")}
        with self.store.write() as session:
            person = session.get(Participant, plan.participant)
            assert person is not None
            version = locking.check(session, person, requester.tags)
            if any(not may_play(session.get(Token, each)) for each in current.tokens):
                raise right_ended()
            row = Test(
                id=plan.test_id, participant=plan.participant, kind=plan.kind, state="requested",
                plan={**stored_plan, "participant_version": version}, summary={}, reason="", requested_by=by,
                requested_utc=now, ran_by=other_than(by, body.ran_by),
            )  # fmt: skip
            entry = {"participant": plan.participant, "kind": plan.kind, "shown": dose, "version": version}
            entry |= {"model": requester.model} if requester.model else {}
            locking.write(session, row, now, by, "start test", plan.test_id, **entry)
            session.add(row)
            current.version = version
        log.info("test requested, kind %s", plan.kind, extra={"test_id": plan.test_id})
        return row

    async def preview(self, body: TestIn) -> dict[str, Any]:
        """A test's duration, dose and pulse widths; nothing is played. With its `plan_hash` it can be started."""
        row = await self._participant(body)
        planned = await self._planned(body, row)
        answer = await self._previewed(planned.plan)
        return {**answer, **planned.extra, "plan_hash": self.previews.add(body, planned, answer, row)}

    async def _previewed(self, plan: messages.TestPlan) -> dict[str, Any]:
        curve = await asyncio.to_thread(self._recruitment, plan.participant)
        return await self.rig.ask(requests.PreviewRequest(plan=plan, recruitment=curve), timeout_s=PREVIEW_S)

    def _recruitment(self, participant: str) -> messages.RecruitmentTable | None:
        """The approved model's recruitment curve, to estimate the torque-time of a plan with."""
        curve = self.versions.recruitment(participant)
        return None if curve is None else messages.RecruitmentTable(**curve)

    async def stop(self, reason: str, by: str) -> messages.StopEvidence:
        """Stop the rig; the audit entry comes after, so that nothing delays the command.

        Raises ApiError: 503 the rig cannot be reached, or it could not confirm that stimulation has stopped.
        """
        self._halted_s = self.clock.monotonic_s()
        subject = self.current.test_id if self.current else "rig"
        try:
            request = requests.StopRequest(reason=reason or "stop pressed", by=by)
            evidence = await self.rig.ask_for(messages.StopEvidence, request, timeout_s=8.0)
        except ApiError as error:
            self.counted.stopped("failed", 0.0)
            await self._note(by, "stop failed", subject, detail=error.detail)
            error.title, error.detail = NOT_CONFIRMED, f"{EMERGENCY} {error.title}: {error.detail}"
            raise
        ended = "confirmed" if evidence.confirmed else "not-confirmed"
        self.counted.stopped(ended, self.clock.monotonic_s() - self._halted_s)
        await self._note(by, "stop", subject, reason=reason, confirmed=evidence.confirmed)
        if not evidence.confirmed:
            detail = f"{EMERGENCY} The rig says: {evidence.detail}"
            raise ApiError(503, "stop-not-confirmed", NOT_CONFIRMED, detail, evidence=evidence.model_dump())
        return evidence

    async def enough(self, row: Test, by: str) -> messages.Extended:
        """End a running test early as complete, where its kind allows that.

        Raises ApiError: 409 it does not run, or is ending; 422 it has a fixed plan.
        """
        answer = await self.rig.ask_for(messages.Extended, requests.EnoughRequest(test_id=row.id, by=by, at_once=True))
        self.kinds[row.kind].said_enough(row.id)
        return answer

    async def _note(self, by: str, action: str, subject: str, **detail: Any) -> None:
        """Write a stop down; a database that is slow or gone does not keep its answer back."""

        def write() -> None:
            for wait_s in NOTE_AGAIN_S:
                try:
                    with self.store.write() as session:
                        audit.write(session, self.clock.utc(), by, action, subject, **detail)
                    return
                except SQLAlchemyError:
                    log.exception("%s could not yet be written into the audit trail", action)
                time.sleep(wait_s)
            log.error("%s is not in the audit trail; the rig's journal has it", action)

        # an executor of its own, which other work cannot exhaust
        noted = asyncio.get_running_loop().run_in_executor(self._notes, write)
        await asyncio.wait({noted}, timeout=NOTE_S)

    # ---- events of the rig ----------------------------------------------------------------------------------

    def _on_event(self, event: AnyEvent) -> None:
        if isinstance(event, messages.LiveEvent):
            self.hub.live(event)
        elif isinstance(event, messages.FinishedEvent):
            self._follow(event.test_id, self._finish(event))
        else:
            if event.status.state in HALTED:
                self._halted_s = self.clock.monotonic_s()
            self.hub.send({"type": "state", "rig": event.status.model_dump(exclude={"finished"})})

    def _on_link(self, connected: bool) -> None:
        self.hub.send({"type": "link", "connected": connected})
        if connected and self.rig.status is not None:
            self._look_for_end(self.rig.status, 1, "the rig's process ended during the test")

    def _on_poll(self, status: messages.Status) -> None:
        """A test whose end was lost on the way must not hold the rig for ever."""
        self._look_for_end(status, MISSED_POLLS, f"the rig is {status.state} and no longer plays this test")

    def _look_for_end(self, status: messages.Status, max_missed: int, why: str) -> None:
        """Treat the current test's end as missed after `max_missed` consecutive states that do not name it.

        A start in progress handles its own outcome.
        """
        current = self.current
        if current is None or not current.started or current.ending:
            return
        current.missed = 0 if status.test_id == current.test_id else current.missed + 1
        if current.missed >= max_missed:
            current.ending = True
            self._follow(current.test_id, self._recover(current.test_id, why))

    def _follow(self, test_id: str, work: Coroutine[Any, Any, None]) -> None:
        """Lead a test to its last state in the background.

        An unexpected error is told as its reason, and the rig is let go. Where the state cannot be written either, the
        next start of the service takes the test up.
        """

        async def guarded() -> None:
            current_test.set(test_id)
            try:
                await work
            except Exception as error:
                log.exception("the test could not be taken over", extra={"test_id": test_id})
                await asyncio.to_thread(self.lifecycle.fail, test_id, error)
            finally:
                self._release(test_id)
                self.announce(test_id)

        self._tasks.begin(guarded())

    async def _finish(self, event: messages.FinishedEvent) -> None:
        """Take over a finished test: store the recording, identify, store the model."""
        if self.current is not None and self.current.test_id == event.test_id:
            self.current.ending = True
        with self.trials.ending():
            row = await asyncio.to_thread(self.lifecycle.take_recording, event)
            if row is None:
                return
            self.announce(row.id)
            if row.kind in self.trials.names and row.state == "completed":
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
            self._unwatch_all()

    def _unwatch_all(self) -> None:
        for kind in self.kinds.all:
            kind.unwatch()

    # ---- after a restart ------------------------------------------------------------------------------------

    async def resume(self) -> None:
        """Take up the tests that a restart of the service left open."""
        self.trials.resume()
        for row in await asyncio.to_thread(self.store.all, Test, Test.state.in_(OPEN_STATES)):
            status = self.rig.status
            over = ("ready", "latched", "uncertain")
            if status is not None and status.test_id == row.id and status.state not in over:
                tokens = row.plan.get("tokens") or []
                current = Current(row.id, row.participant, row.requested_by, row.kind, True, tokens=tokens)
                current.version = row.plan.get("participant_version", 0)
                current.until_utc = await asyncio.to_thread(self.until_utc, tokens)
                self.current = current
                self.hub.begin(row.id)
                self._tasks.begin(self.look_again_and_again(current))
            else:
                self._follow(row.id, self._recover(row.id, "the service was restarted during the test"))

    async def _recover(self, test_id: str, why: str) -> None:
        """A test whose end was not heard: its recording, if the rig sealed one, is adopted."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)
        if row.recording_id is not None:
            await self.lifecycle.identify(test_id)
        else:
            await self._finish(await self.lifecycle.missed_end(test_id, why))

    # ---- documents -------------------------------------------------------------------------------------------

    def announce(self, test_id: str) -> None:
        """Publish the test's state on the live channel, in call order."""
        read = asyncio.get_running_loop().run_in_executor(self._telling, self._read_document, test_id)
        read.add_done_callback(self._publish_document)

    def _read_document(self, test_id: str) -> dict[str, Any] | None:
        row = self.store.get(Test, test_id)
        return None if row is None else self.document(row)

    def _publish_document(self, read: asyncio.Future[dict[str, Any] | None]) -> None:
        if read.cancelled():
            return
        if (error := read.exception()) is not None:
            log.error("how a test stands could not be read", exc_info=error)
        elif (document := read.result()) is not None:
            self.hub.send({"type": "test", "test": document})

    def document(self, row: Test, fits: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """A test as clients see it; `fits` as `Lifecycle.document` takes them."""
        return self.lifecycle.document(row, self.hub.position(row.id), fits)

    def documents(
        self, participant: str, models: list[dict[str, Any]], limit: int | None = None
    ) -> list[dict[str, Any]]:
        """A participant's tests, newest first; `models`: documents of all of the participant's, read at once."""
        fits, of_participant = {model["id"]: model for model in models}, Test.participant == participant
        rows = self.lifecycle.store.all(Test, of_participant, order=Test.requested_utc.desc(), limit=limit)
        return [self.document(row, fits) for row in rows]

    async def close(self) -> None:
        """Stop following; the next start of the service resumes."""
        await self._tasks.close()
        for kind in self.kinds.all:
            await kind.close()
        await asyncio.to_thread(self._notes.shutdown)
        await asyncio.to_thread(self._telling.shutdown)


def not_what_was_seen() -> ApiError:
    """Return the 409 for a plan that differs from the previewed one."""
    detail = "The rig would now play something else: it was set up anew. Nothing was started. Go back and check."
    return ApiError(409, "changed-meanwhile", "This page is out of date", detail)
