"""Participants: codes and a profile of limits, no names; their site, to which models and keys belong; notes."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from stimrig.api.services import notes, participants
from stimrig.api.sessions.requests import MuscleIn, NoteIn, ParticipantIn, ProfileIn
from stimrig.api.store.tables import Participant
from stimrig.api.web.dependencies import PROBLEM, Ctx, ParticipantDecision, Tester
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.people import ChangedOut, NoteOut, ParticipantOut

router = APIRouter(prefix="/v1/participants", tags=["participants"], responses=PROBLEM)


@router.post("", status_code=201, **describe_answer(ParticipantOut, 201, "made; see `Location`"))
def make_participant(context: Ctx, principal: Tester, body: ParticipantIn, response: Response) -> dict[str, Any]:
    """Make a participant: a code, never a name."""
    row = participants.create(context, body, principal.name)
    response.headers["Location"] = f"/v1/participants/{row.code}"
    return row.as_dict()


@router.get("", **describe_answer(list[ParticipantOut]))
def list_participants(
    context: Ctx,
    _principal: Tester,
    q: Annotated[str, Query(max_length=80, description="a part of the code, in any case")] = "",
) -> list[dict[str, Any]]:
    """All participants, or those that are looked for; who was last tested, or made, comes first."""
    return [row.as_dict() for row in participants.matching(context.store, q)]


@router.get("/{code}", **describe_answer(ParticipantOut))
def one_participant(context: Ctx, _principal: Tester, code: str, response: Response) -> dict[str, Any]:
    """One participant with its profile."""
    return tagged(response, participants.find(context, code))


def tagged(response: Response, row: Participant) -> dict[str, Any]:
    """Return a participant's document, with its version as `ETag`."""
    response.headers["ETag"] = f'"{row.version}"'
    return row.as_dict()


@router.put("/{code}/profile", **describe_answer(ChangedOut))
async def set_profile(
    context: Ctx, code: str, decision: ParticipantDecision, body: ProfileIn, response: Response
) -> dict[str, Any]:
    """Change limits: those that are sent; the others keep their values, and so does what a calibration found.

    A limit wider than at the calibration voids it: 409, until it is confirmed. Who is signed in also confirms a limit
    that rises by more than a quarter. `meanwhile` says what it means for a
    test that runs, or a calibration that is open.
    """
    row = await participants.change_profile(context, code, body.sent(), decision)
    return {**tagged(response, row), "meanwhile": participants.effect_on_open_work(context, code)}


@router.put("/{code}/muscle", **describe_answer(ParticipantOut))
async def set_muscle(
    context: Ctx, code: str, decision: ParticipantDecision, body: MuscleIn, response: Response
) -> dict[str, Any]:
    """Say the site. Another one than before voids the calibration: 409, until it is confirmed.

    A model belongs to the site at which it was measured: at another one there is no approved model, and no key of a
    controller, until it has its own. Tests keep the site that they were begun with.
    """
    return tagged(response, await participants.change_site(context, code, body, decision))


notes_router = APIRouter(prefix="/v1/participants/{code}/notes", tags=["notes"], responses=PROBLEM)


@notes_router.get("", **describe_answer(list[NoteOut]))
def list_notes(context: Ctx, _principal: Tester, code: str) -> list[dict[str, Any]]:
    """A participant's notes, newest first, the struck ones among them."""
    participants.find(context, code)
    return [note.as_dict() for note in notes.of_participant(context.store, code)]


@notes_router.post("", status_code=201, **describe_answer(NoteOut, 201, "written"))
async def write_note(context: Ctx, principal: Tester, code: str, body: NoteIn) -> dict[str, Any]:
    """Write a note on the participant's session, on a test (`test_id`), or at a time in it (`at_s`, or `now`)."""
    return (await notes.add(context, code, body, principal.name)).as_dict()


@notes_router.post("/{note_id}/strike", **describe_answer(NoteOut))
def strike_note(context: Ctx, principal: Tester, code: str, note_id: str) -> dict[str, Any]:
    """Mark a note as wrong: it stays readable, with who struck it."""
    return notes.strike(context, code, note_id, principal.name).as_dict()
