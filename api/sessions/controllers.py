"""Controllers: keys bound to one participant, one day and a plan of trials; the trials that a key may play."""

from __future__ import annotations

import asyncio
import json
import secrets
from typing import Annotated, Any

from pydantic import Field, FiniteFloat, StringConstraints

from stimrig.api.errors import ApiError, forbidden, require_found
from stimrig.api.models.places import site_of
from stimrig.api.people.auth import Auth, Principal, Scope, outside
from stimrig.api.sessions.playing import Requester
from stimrig.api.sessions.profiles import LIMITS, above
from stimrig.api.sessions.requests import Body, CurrentMa, ProfileIn, TestIn, WidthUs
from stimrig.api.sessions.runner import Runner
from stimrig.api.sessions.trials import SEQUENCE
from stimrig.api.store import locking
from stimrig.api.store.audit import digest
from stimrig.api.store.locking import ChangedError, Tags
from stimrig.api.store.tables import Participant, Test, Token

LONGEST_S = 300.0
HALTED = "The rig is stopped", "A person looks at participant and rig and re-arms it."
NEUTRAL = {
    "rig-busy": ("Another test is running", "The rig is in use. Wait until it is free."),
    "rig-latched": HALTED,
    "rig-uncertain": HALTED,
}
"""Messages to a key, in place of texts that may name another participant."""
LIMITED = ("current_ma", "max_pulse_width_us")
"""Limits that a plan narrows."""
SAME_RATE = 1e-3
"""Share by which a pulse rate may differ from the model's: what writing and reading a number leaves."""
MOST_TRIALS = 200


class PlanIn(Body):
    """Plan of a controller's trials."""

    current_ma: CurrentMa
    max_pulse_width_us: WidthUs
    max_duration_s: Annotated[FiniteFloat, Field(gt=0, le=LONGEST_S, description="of one trial, rests included, s")]
    trials: Annotated[int, Field(ge=1, le=MOST_TRIALS, description="that are played")]


class KeyFor(PlanIn):
    """A key's name and plan."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_. -]{1,60}$")]


async def start(runner: Runner, principal: Principal, body: TestIn, tags: Tags | None) -> Test:
    """Start a test; where a controller's key asks for it, within its plan.

    `tags`: versions of the participant; of a key, those of the model that the trial was planned with.

    Raises ApiError: 403 outside the key or its plan, and by how much; 409 no model of its participant is approved; else
    as `Runner.start`.
    """
    if principal.participant is None:
        return await runner.start(body, Requester(principal.name, principal.token_hash, tags))
    async with runner.keys_lock:  # two requests must not both use the last remaining trial
        try:
            _refuse_kind(principal, body)
            participant: Participant = await asyncio.to_thread(runner.store.get, Participant, principal.participant)
            model = await asyncio.to_thread(_model_sent, runner, body, tags or ())
            body = await _within_plan(runner, principal, body, participant)
            version = (str(participant.version),)  # the version that plan and model were checked against
            return await runner.start(body, Requester(principal.name, principal.token_hash, version, model))
        except ChangedError:
            raise trial_overtaken() from None
        except ApiError as error:
            if error.code in NEUTRAL:
                error.title, error.detail = NEUTRAL[error.code]
                error.extra.clear()
            raise


def _refuse_kind(principal: Principal, body: TestIn) -> None:
    if body.participant != principal.participant:
        raise outside(principal.participant)
    if body.kind != SEQUENCE:
        raise beyond(f"The kind is {body.kind!r}. Send kind {SEQUENCE!r}")
    if body.segments is None:
        raise beyond("No segments were sent. Send the trial's segments")
    if wrong := [name for name in ("joins", "ran_by") if getattr(body, name) is not None]:
        raise beyond(f"A key sends no {wrong[0]}. Leave it out")


def _model_sent(runner: Runner, body: TestIn, sent: Tags) -> str:
    """Return the sent tag that matches the model served now: the approved one, or its tracked version.

    A key plays at the rate of the approved model: a person who made the key chose no other.

    Raises ApiError: 412 none of them is; 409 no model is approved; 403 another rate.
    """
    served = runner.versions.served(body.participant)
    if served is None:
        raise unapproved(body.participant)
    tracked = runner.trials.tracked.served(body.participant)
    tag = next((tag for each in (served, tracked) if each and (tag := each.etag.strip('"')) in sent), None)
    if tag is None:
        raise trial_overtaken()
    own_hz = float(json.loads(served.body)["pulse_rate_hz"])
    if not abs(body.pulse_rate_hz - own_hz) <= SAME_RATE * own_hz:
        mismatch = f"pulse_rate_hz {body.pulse_rate_hz:g} is not the approved model's {own_hz:g}"
        raise beyond(f"{mismatch} (40, where none is sent). Send the model's pulse_rate_hz")
    return tag


async def _within_plan(runner: Runner, principal: Principal, body: TestIn, participant: Participant) -> TestIn:
    """Return the test narrowed to the plan's limits; refuse one beyond the plan."""
    plan = principal.plan or {}
    begun = (Test.requested_by == principal.name, Test.state != "refused")  # tests that the rig refused do not count
    if len(await asyncio.to_thread(runner.store.all, Test.id, *begun)) >= plan["trials"]:
        raise beyond(f"All trials of this key are played: {plan['trials']}. A person can make another key")
    profile, sent = body.profile or ProfileIn(), body.profile.sent() if body.profile else {}
    for name, words in above({name: sent[name] for name in LIMITED if name in sent}, plan, "the plan's").items():
        raise beyond(f"{name} {words}")
    limits = {name: min(sent.get(name, plan[name]), plan[name], participant.profile[name]) for name in LIMITED}
    narrowed = body.model_copy(update={"profile": profile.model_copy(update=limits)})
    preview = await runner.preview(narrowed)
    if not preview["duration_s"] <= plan["max_duration_s"] + 1e-9:
        raise beyond(f"{preview['duration_s']:g} s is longer than the plan's {plan['max_duration_s']:g} s")
    widest_us = max(preview["pulse_width_us"], default=0.0)
    if not widest_us <= plan["max_pulse_width_us"]:
        raise beyond(f"A pulse of {widest_us:g} µs is above the plan's {plan['max_pulse_width_us']:g} µs")
    return narrowed


def unapproved(participant: str) -> ApiError:
    """409: a key does nothing with a participant for whom no model holds."""
    detail = (
        f"No model of {participant} is approved now. A person approves one on its page. An approval ends with its day, "
        "or when the model is rejected."
    )
    return ApiError(409, "no-approved-model", "No approved model", detail)


def trial_overtaken() -> ApiError:
    """412: the trial was planned on what is no longer so; a key learns no more of it."""
    detail = "Fetch the model anew, compute the trial with it, and send its ETag as If-Match."
    return ApiError(412, "changed-meanwhile", "What the trial was planned with was changed", detail)


def beyond(why: str) -> ApiError:
    """403: not within the plan."""
    return ApiError(403, "beyond-plan", "Not within the plan of this key", f"{why}.")


KEY_SCOPES = [Scope.READ_MODEL, Scope.READ_LIVE, Scope.RUN_TEST]
"""The scopes of a key; `stimrig.api.web.guards` restricts which calls they open."""


def make_key(auth: Auth, maker: Principal, participant: str, body: KeyFor, tags: Tags | None) -> tuple[str, Token, int]:
    """Make a key that ends with its day: its text, shown this once, its row, and the participant's new version.

    Once the token of who makes it is revoked or has expired, the key opens nothing.

    Raises ApiError: 403 who makes it lacks a scope of the key; 404 no such participant; 412 changed since
    it was seen; 422 the plan is wider than the participant's limits.
    """
    if lacking := [str(scope) for scope in KEY_SCOPES if not maker.may(scope)]:
        held_by_key = ", ".join(KEY_SCOPES)
        detail = f"A key holds {held_by_key}. Who makes one holds them all; {maker.name} lacks {', '.join(lacking)}."
        raise forbidden(detail)
    text, now = f"stimrig_{secrets.token_urlsafe(32)}", auth.clock.utc()
    with auth.store.write() as session:
        person: Participant = require_found(session.get(Participant, participant), "participant", participant)
        locking.check(session, person, tags)
        plan = body.model_dump(exclude={"name"})
        wider = above({name: plan[name] for name in LIMITED}, person.profile, "the limit of today,")
        for name, words in wider.items():
            detail = f"{LIMITS[name].words}: {words}."
            raise ApiError(422, "wider-profile", "Wider than the participant's limits", detail)
        row = Token(
            hash=digest(text), prefix=text[:12], created_utc=now, expires_utc=auth.clock.end_of_day_utc(),
            name=f"{body.name} ({digest(text)[:6]})",  # unique, since tests are counted by it
            participant=participant, plan={**plan, "site": site_of(person)}, scopes=list(map(str, KEY_SCOPES)),
            made_by=maker.token_hash,
        )  # fmt: skip
        session.add(row)
        bound = {"participant": participant, "plan": row.plan, "until": row.expires_utc}
        locking.write(session, person, now, maker.name, "issue token", row.name, scopes=row.scopes, **bound)
    return text, row, person.version


def keys_of(auth: Auth, participant: str) -> list[dict[str, Any]]:
    """Today's keys of a participant, newest first; `id` is for `revoke`, `state` says whether it opens anything."""
    today = Token.participant == participant, Token.created_utc >= auth.clock.start_of_day_utc()

    def state(row: Token) -> str:
        if row.revoked or auth.creator_lost_rights(row):
            return "revoked"
        return "expired" if row.expires_utc is not None and row.expires_utc <= auth.clock.utc() else "valid"

    rows = auth.store.all(Token, *today, order=Token.created_utc.desc())
    return [{"id": row.hash[:16], "state": state(row), **row.as_dict()} for row in rows]


def has_key(auth: Auth, participant: str) -> bool:
    """Return whether a valid controller key exists for a participant."""
    return any(row["state"] == "valid" for row in keys_of(auth, participant))


def revoke_key(auth: Auth, participant: str, token_id: str, by: str) -> bool:
    """Revoke a key of a participant; False where there is none of that id."""
    return token_id in {row["id"] for row in keys_of(auth, participant)} and auth.revoke(token_id, by)
