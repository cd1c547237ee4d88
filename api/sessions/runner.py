"""Starts tests, one at a time, and follows each to its end: intent in the database, command to the rig, recording."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

from stimrig.api.clock import request_received_s
from stimrig.api.errors import ApiError, NotFoundError
from stimrig.api.jobs.pool import Pool
from stimrig.api.jobs.tasks import Tasks
from stimrig.api.logs import current_test
from stimrig.api.models.analyses import Analyses
from stimrig.api.models.places import in_words, site_of
from stimrig.api.sessions.adaptive import AdaptiveTests
from stimrig.api.sessions.joint import JointTests
from stimrig.api.sessions.kinds import Kind, Kinds, Planned
from stimrig.api.sessions.lifecycle import Lifecycle
from stimrig.api.sessions.live import Hub
from stimrig.api.sessions.playing import Current, Playing, Requester, may_play, other_than, right_ended
from stimrig.api.sessions.previews import Preview, Previews, refuse_changed
from stimrig.api.sessions.requests import TestIn, limits_of
from stimrig.api.sessions.rig_client import News, RigClient
from stimrig.api.sessions.stops import Stops
from stimrig.api.sessions.trials import Trials
from stimrig.api.store import audit, locking
from stimrig.api.store.locking import Tags
from stimrig.api.store.tables import OPEN_STATES, Participant, Test, Token
from stimrig.rig import messages, requests

log = logging.getLogger("stimrig.trials")
HALTED = ("latched", "uncertain", "disconnected")
START_S = 10.0
"""From the request to the command to the rig: nobody waits with a hand on the button for longer."""
ANSWER_S = 15.0
"""So long the rig may take to answer a start."""
MOST_PREVIEWS = 4
PREVIEW_S = 35.0
"""Far longer than all previews that may wait in the rig take: each takes up to a third of a second. A start or a
re-arming before them may wait for its devices."""
MISSED_POLLS = 3
"""After so many states that don't name the test, its end was lost: it comes within milliseconds of the state."""


class Runner(Playing):
    """The tests of this service."""

    def __init__(
        self, analyses: Analyses, rig: RigClient, stops: Stops, trials: Trials, adviser: Pool, limits_lock: asyncio.Lock
    ) -> None:
        super().__init__(analyses.store, analyses.clock, rig)
        self.versions, self.pool, self.stops = analyses.versions, analyses.pool, stops
        self.trials, self.limits_lock = trials, limits_lock
        self.previews, self.hub = Previews(self.clock), Hub(self.clock)
        self._previewing = 0
        self.adaptive = AdaptiveTests(self.clock, rig, self.versions, adviser, self.hub.send)
        self.joint = JointTests(self.clock, rig, self.versions, self.hub.send)
        self.kinds = Kinds(Kind(rig), trials, self.adaptive, self.joint)
        self.lifecycle = Lifecycle(analyses, rig, self.kinds, self.hub)
        self.document, self.documents = self.lifecycle.document, self.lifecycle.documents
        self.keys_lock = asyncio.Lock()
        """Trials of controllers' keys are counted and begun one after the other."""
        self._tasks = Tasks(log)
        rig.listeners.append(self._on_news)

    # ---- before a test -----------------------------------------------------------------------------------------

    async def preview(self, body: TestIn) -> dict[str, Any]:
        """Return a test's duration, dose and pulse widths. With its `plan_hash` it can be started.

        Raises ApiError: 503 so many are computed already.
        """
        if self._previewing >= MOST_PREVIEWS:
            detail = f"{MOST_PREVIEWS} previews are in work already. Try again in 1 s."
            problem = ApiError(503, "crowded", "Too many previews at once", detail)
            problem.headers["Retry-After"] = "1"
            raise problem
        self._previewing += 1
        try:
            participant = await asyncio.to_thread(self._participant, body.participant)
            planned = await self._planned(body, participant)
            answer = await self._previewed(planned.plan)
        finally:
            self._previewing -= 1
        return {**answer, **planned.extra, "plan_hash": self.previews.add(body, planned, answer, participant)}

    async def joint_overview(self, participant: Participant) -> dict[str, Any]:
        """Return today's open guided tests of a joint. Raises ApiError: the rig does not answer."""
        return await self.joint.overview(self._plan(TestIn(participant=participant.code), participant), PREVIEW_S)

    def _participant(self, code: str, tags: Tags | None = None) -> Participant:
        with self.store.read() as session:
            participant = session.get(Participant, code)
            if participant is None:
                raise NotFoundError("participant", code, "POST /v1/participants makes one.")
            locking.check(session, participant, tags)
        return participant

    def _plan(self, body: TestIn, participant: Participant) -> messages.TestPlan:
        segments = [messages.SegmentPlan(**segment.model_dump()) for segment in body.segments or ()] or None
        return messages.TestPlan(
            test_id=self._new_id(),
            **{name: getattr(body, name) for name in messages.LABELS},
            segments=segments,
            protocol=body.protocol,
            pulse_rate_hz=body.pulse_rate_hz,
            **limits_of(body, participant.profile),
        )

    def _new_id(self) -> str:
        stamp = self.clock.utc()[:19].replace("-", "").replace(":", "")
        return f"T{stamp}-{secrets.token_hex(3)}"

    async def _planned(self, body: TestIn, participant: Participant) -> Planned:
        plan = self._plan(body, participant)
        if body.joins is not None:
            await asyncio.to_thread(self._check_joins, body.joins, participant, plan)
        return await self.kinds[body.kind].planned(body, plan, PREVIEW_S)

    def _check_joins(self, joins: str, participant: Participant, plan: messages.TestPlan) -> None:
        """Refuse to join the recording to that of another participant's model, of another place or unknown current."""
        model = self.versions.get(joins)
        if model.participant != participant.code:
            detail = f"{model.id} is a model of {model.participant}, the test is for {participant.code}."
            raise ApiError(422, "other-participant", "The model is another participant's", detail)
        there, before_ma = self.versions.measured_at(model)
        here, now_ma = site_of(participant), plan.profile.current_ma
        title = "The recordings could not be joined"
        if there is not None and there != here:
            detail = f"The model was measured at {in_words(there)}, this test is at {in_words(here)}."
            raise ApiError(409, "other-site", title, detail)
        if before_ma is None:
            raise ApiError(409, "unknown-current", title, self.versions.why_not_joined(model))
        if before_ma != now_ma:
            detail = f"The model was measured with {before_ma:g} mA, this test is with {now_ma:g} mA."
            raise ApiError(409, "other-current", title, detail)

    async def _previewed(self, plan: messages.TestPlan) -> dict[str, Any]:
        """Ask the rig what it would play; the approved model's recruitment curve estimates the torque-time."""
        curve = await asyncio.to_thread(self.versions.recruitment, plan.participant)
        table = None if curve is None else messages.RecruitmentTable(**curve)
        return await self.rig.ask(requests.PreviewRequest(plan=plan, recruitment=table), timeout_s=PREVIEW_S)

    # ---- start -------------------------------------------------------------------------------------------------

    async def start(self, body: TestIn, requester: Requester) -> Test:
        """Start a test, with `plan_hash` the previewed one; started from it twice, the first test is returned.

        Raises ApiError: 404 no such participant; 412 it was changed; 409 another test runs, the holder named; 409 it
        would not be what was seen, or a stop came since it was asked for; 410 no such preview; 503 that was too long
        ago; what the rig refuses.
        """
        if body.plan_hash is None:
            return await self._start(body, requester)
        preview = self.previews.find(body.participant, body.plan_hash)
        async with preview.starting:
            if preview.test_id is None:
                return await self._start(preview.body, requester, preview)
        return await asyncio.to_thread(self.store.get, Test, preview.test_id)

    async def _start(self, body: TestIn, requester: Requester, preview: Preview | None = None) -> Test:
        await self.let_end()
        self.refuse_second()
        participant = await asyncio.to_thread(self._participant, body.participant, requester.tags)
        if preview is None:
            planned = await self._planned(body, participant)
        else:
            refuse_changed(preview, participant)
            plan = preview.planned.plan.model_copy(update={"test_id": self._new_id()})
            planned = replace(preview.planned, plan=plan)
        plan = planned.plan
        tokens = await asyncio.to_thread(self.tokens_of, requester.token)
        until_utc = await asyncio.to_thread(self.until_utc, tokens)
        self.refuse_second()  # no await between here and the next line
        current = self.current = Current(
            plan.test_id, plan.participant, requester.name, plan.kind, tokens=tokens, until_utc=until_utc
        )
        current_test.set(plan.test_id)
        try:
            answer = await self._previewed(plan)
            torque_time = {"torque_time_nms": answer["torque_time_nms"]}  # an estimate, by the model approved now
            if preview is not None and answer != {**preview.answer, **torque_time}:
                detail = "The rig would now play something else. Nothing was started. Go back and check."
                raise ApiError(409, "changed-meanwhile", "This page is out of date", detail)
            await asyncio.to_thread(self._write_intent, planned, answer, current, body, requester)
            self.hub.begin(plan.test_id)
            await self._command(planned, current)
        except BaseException:
            self.current = None
            self._unwatch_all()
            raise
        current.started = True
        if preview is not None:
            preview.test_id = plan.test_id
        self._tasks.begin(self.look_again_and_again(current))
        try:
            return await asyncio.to_thread(self.lifecycle.update, plan.test_id, state="running")
        except Exception:  # the requester gets an error, so the test must not keep playing
            await self.stop_quietly(f"start of {plan.test_id} could not be written down")
            raise

    def _write_intent(
        self, planned: Planned, preview: dict[str, Any], current: Current, body: TestIn, requester: Requester
    ) -> None:
        now, plan, by = self.clock.utc(), planned.plan, requester.name
        with self.store.write() as session:
            person = session.get(Participant, plan.participant)
            assert person is not None
            version = locking.check(session, person, requester.tags)
            if any(not may_play(session.get(Token, each)) for each in current.tokens):
                raise right_ended()
            stored_plan: dict[str, Any] = {
                **plan.model_dump(),
                "preview": preview,
                "joins": body.joins,
                **dict(zip(("side", "muscle", "placement"), site_of(person), strict=True)),
                "tokens": current.tokens,
                **planned.extra,
                **self.kinds[body.kind].stored_fields(body, len(preview["pulse_width_us"])),
                "participant_version": version,
            }
            row = Test(
                id=plan.test_id, participant=plan.participant, kind=plan.kind, state="requested", plan=stored_plan,
                summary={}, reason="", requested_by=by, requested_utc=now, ran_by=other_than(by, body.ran_by),
            )  # fmt: skip
            dose = {name: preview.get(name) for name in ("duration_s", "charge_uc", "torque_time_nms")}
            entry = {"participant": plan.participant, "kind": plan.kind, "shown": dose, "version": version}
            entry |= {"model": requester.model} if requester.model else {}
            audit.write(session, now, by, "start test", plan.test_id, **entry)
            session.add(row)
            current.version = version
        log.info("test requested, kind %s", plan.kind, extra={"test_id": plan.test_id})

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
            reason = error.detail or error.title
            await asyncio.to_thread(self.lifecycle.update, plan.test_id, state="refused", reason=reason)
            status = self.rig.status
            if error.code == "rig-busy" and status is not None:
                error.extra["holder"] = {"test_id": status.test_id, "participant": status.participant}
            raise
        except Exception as error:  # any error: a test that never began must not stay open
            await self.stop_quietly(f"start of {plan.test_id} failed")
            await asyncio.to_thread(self.lifecycle.fail, plan.test_id, error)
            raise

    def _refuse_overtaken(self, since_s: float) -> None:
        """Refuse a start that a stop has overtaken, or whose requester has long given up."""
        if self.stops.halted_s >= since_s:
            detail = "Nothing was sent. Check the participant and the rig, re-arm the rig, and start again."
            raise ApiError(409, "stopped-meanwhile", "The start was cancelled by a stop", detail)
        if not (self.clock.monotonic_s() - since_s <= START_S):
            detail = f"It could not begin within {START_S:g} s. Nothing was sent. Start again."
            raise ApiError(503, "too-late", "The start took too long", detail)

    async def enough(self, row: Test, by: str) -> messages.Extended:
        """End a running test early as complete, where its kind allows that.

        Raises ApiError: 409 it does not run, or is ending; 422 it has a fixed plan.
        """
        answer = await self.rig.ask_for(messages.Extended, requests.EnoughRequest(test_id=row.id, by=by, at_once=True))
        self.kinds[row.kind].said_enough(row.id)
        return answer

    # ---- to the end of a test ----------------------------------------------------------------------------------

    def _on_news(self, news: News) -> None:
        if isinstance(news, messages.LiveEvent):
            self.hub.live(news)
            for kind in self.kinds.all:
                kind.hear(news)
        elif isinstance(news, messages.FinishedEvent):
            self._follow(news.test_id, self._finish(news))
        elif isinstance(news, messages.StateEvent):
            if news.status.state in HALTED:
                self.stops.halted_s = self.clock.monotonic_s()
            self.hub.send({"type": "state", "rig": news.status.model_dump(exclude={"finished"})})
        elif isinstance(news, messages.Status):
            self._look_for_end(news, MISSED_POLLS)
        else:
            self.hub.send({"type": "link", "connected": news})
            for kind in () if news else self.kinds.all:
                kind.hear(None)
            if news and self.rig.status is not None:
                self._look_for_end(self.rig.status, 1)

    def _look_for_end(self, status: messages.Status, max_missed: int) -> None:
        """Treat the current test's end as missed after `max_missed` consecutive states that do not name it.

        So no test whose end was lost holds the rig for ever. A start in progress handles its own outcome.
        """
        current = self.current
        if current is None or not current.started or current.ending:
            return
        current.missed = 0 if status.test_id == current.test_id else current.missed + 1
        if current.missed >= max_missed:
            current.ending = True
            why = f"the rig's process ended, or the end was not reported; the rig is {status.state} now"
            self._follow(current.test_id, self._recover(current.test_id, why))

    def _follow(self, test_id: str, work: Coroutine[Any, Any, None]) -> None:
        """Lead a test to its last state in the background, then let the rig go.

        An unexpected error becomes its reason. Where the state cannot be written either, the next start of the service
        takes the test up.
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
                self.lifecycle.announce(test_id)

        self._tasks.begin(guarded())

    async def _finish(self, event: messages.FinishedEvent) -> None:
        """Take over a finished test: store the recording, identify, store the model."""
        if self.current is not None and self.current.test_id == event.test_id:
            self.current.ending = True
        with self.trials.ending():
            row = await asyncio.to_thread(self.lifecycle.take_recording, event)
            if row is None:
                return
            self.lifecycle.announce(row.id)
            if row.kind in self.trials.names and row.state == "completed":
                self._release(event.test_id)
                await self.trials.follow(row.id, event.last_sample_unix_s)
        if row.state == "identifying":
            self._release(event.test_id)
            await self.lifecycle.identify(row.id, event.last_sample_unix_s)

    def _release(self, test_id: str) -> None:
        """Let the rig go; the identification goes on beside the next test."""
        if self.current is not None and self.current.test_id == test_id:
            self.current.let_go.set()
            self.current = None
            self._unwatch_all()

    def _unwatch_all(self) -> None:
        for kind in self.kinds.all:
            kind.unwatch()

    async def resume(self) -> None:
        """Take up the tests that a restart of the service left open."""
        self.trials.resume()
        for row in await asyncio.to_thread(self.store.all, Test, Test.state.in_(OPEN_STATES)):
            status = self.rig.status
            if status is None or status.test_id != row.id or status.state in ("ready", "latched", "uncertain"):
                self._follow(row.id, self._recover(row.id, "the service was restarted during the test"))
                continue
            tokens = row.plan.get("tokens") or []
            current = Current(row.id, row.participant, row.requested_by, row.kind, True, tokens=tokens)
            current.version = row.plan.get("participant_version", 0)
            current.until_utc = await asyncio.to_thread(self.until_utc, tokens)
            self.current = current
            self.hub.begin(row.id)
            self._tasks.begin(self.look_again_and_again(current))

    async def _recover(self, test_id: str, why: str) -> None:
        """Take over a test whose end was missed: its recording, if the rig sealed one, is adopted."""
        row: Test = await asyncio.to_thread(self.store.get, Test, test_id)
        if row.recording_id is not None:
            await self.lifecycle.identify(test_id)
        else:
            await self._finish(await self.lifecycle.missed_end(test_id, why))

    async def close(self) -> None:
        """Stop following; the next start of the service resumes."""
        await self._tasks.close()
        for kind in self.kinds.all:
            await kind.close()
        await self.lifecycle.close()
