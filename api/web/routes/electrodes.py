"""Which electrode of an array: a search plays one stimulus at a time, is told what was seen, and is closed."""

from __future__ import annotations

import asyncio
import secrets
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Response
from pydantic import Field, FiniteFloat, StrictBool, StringConstraints

from stimrig.api.errors import ApiError, require_found
from stimrig.api.models.places import site_of
from stimrig.api.sessions import channels, electrodes, profiles
from stimrig.api.sessions.electrodes import Array
from stimrig.api.sessions.playing import refuse_archived
from stimrig.api.sessions.requests import Body, CurrentMa, WidthUs
from stimrig.api.store import audit, seen
from stimrig.api.store.tables import Participant, Recording, Search
from stimrig.api.web.dependencies import PROBLEM, Context, Ctx, Tester, in_limits_turn
from stimrig.api.web.responses.base import describe_answer
from stimrig.api.web.responses.electrodes import SearchOut
from stimrig.api.web.routes import participants

router = APIRouter(prefix="/v1", tags=["electrodes"], responses=PROBLEM)
Element = Annotated[int, Field(ge=1, le=128)]
Elements = Annotated[list[Element], Field(min_length=1, max_length=2, description="one element, or a pair")]
Count = Annotated[int, Field(ge=1, le=128)]
LISTED = "GET /v1/participants/{code}/searches lists them."


class SearchIn(Body):
    """A new search over the rig's array; of the layout only what the rig file does not tell."""

    wish: Literal["strong", "selective", "comfortable", "balanced"] = Field("balanced", description="what is wanted")
    direction: Literal["flexion", "extension"] = Field("flexion", description="of the wanted torque")
    width_us: WidthUs | None = Field(None, description="of all stimuli, µs; None: the participant's comfort maximum")
    current_ma: CurrentMa | None = Field(None, description="of all stimuli, mA; None: the participant's own")
    rows: Count | None = Field(None, description="of elements, which are numbered along them")
    columns: Count | None = Field(None, description="elements of a row")
    pitch_mm: FiniteFloat | None = Field(None, gt=0, le=100, description="from one element's middle to the next, mm")


class PlayIn(Body):
    """What is stimulated next."""

    elements: Elements | None = Field(None, description="null: those that are proposed")


class SeenIn(Body):
    """What the last stimulus gave; its torque is in its recording."""

    test_id: Annotated[str, StringConstraints(max_length=40)] = Field(description="of the stimulus")
    spill: Literal["none", "slight", "strong"] = Field(description="how far other muscles moved")
    comfort: Annotated[FiniteFloat, Field(ge=0, le=10, description="0 unbearable, 10 unnoticed")]


class ChoiceIn(Body):
    """The electrode that is used from now on."""

    elements: Elements
    void_calibration: StrictBool = Field(
        False, description="although the channel was calibrated at other elements, which ends that calibration"
    )


def find(context: Context, search_id: str) -> Search:
    """A search by its id; 404 where there is none."""
    return require_found(context.store.get(Search, search_id), "search", search_id, LISTED)


def searches_of(context: Context, code: str) -> list[Search]:
    """A participant's, newest first."""
    return context.store.all(Search, Search.participant == code, order=Search.created_utc.desc())


def laid(array: Array, body: SearchIn) -> dict[str, Any]:
    """How the array lies. Raises ApiError (422): nobody has told, or it is not what the switch connects."""
    asked = body.model_dump(include={"rows", "columns", "pitch_mm"}) | array.laid
    if lacking := [name for name, value in asked.items() if value is None]:
        raise ApiError(422, "invalid-input", "It is not known how the array lies", f"Send {', '.join(lacking)}.")
    if asked["rows"] * asked["columns"] != array.elements:
        detail = f"{asked['rows']} × {asked['columns']} are not the {array.elements} elements of the switch."
        raise ApiError(422, "invalid-input", "The array has another number of elements", detail)
    return asked


async def ask_worker(context: Context, **asked: Any) -> dict[str, Any]:
    """What the search says."""
    return await context.pool.submit("electrodes", urgent=True, **asked).result


def put(context: Context, row_id: str, count: int, found: dict[str, Any], told: list[dict[str, Any]]) -> Search:
    """Keep what was found, if nothing was told meanwhile. Raises ApiError (409)."""
    with context.store.write() as session:
        row = session.get(Search, row_id)
        assert row is not None
        if len(row.told) != count:
            raise ApiError(409, "changed-meanwhile", "Somebody has told it", "Look at the search first.")
        row.document, row.standing, row.told = found["search"], found["standing"], [*row.told, *told]
        if row.state != "closed":
            row.state = "enough" if found["standing"]["enough"] else "open"
        for one in told:
            about = {name: value for name, value in one.items() if name not in ("by", "at_utc")}
            audit.write(session, one["at_utc"], one["by"], "tell stimulus", row.id, **about)
    return row


async def standing(context: Context, row: Search) -> dict[str, Any]:
    """A search as clients see it; proposed anew where a stimulus was stopped since."""
    found = await asyncio.to_thread(electrodes.document, context.store, row)
    if found["left_out"] != row.standing["left_out"]:
        anew = await ask_worker(context, search=row.document, left_out=found["left_out"])
        row = await asyncio.to_thread(put, context, row.id, len(row.told), anew, [])
        found = await asyncio.to_thread(electrodes.document, context.store, row)
    return found


@router.post("/participants/{code}/searches", status_code=201, **describe_answer(SearchOut, 201, "begun"))
async def begin_search(context: Ctx, who: Tester, code: str, body: SearchIn, response: Response) -> dict[str, Any]:
    """Begin a search; nothing is sent yet. The participant's former ones on the channel are its prior."""
    person = await asyncio.to_thread(participants.find, context, code)
    refuse_archived(person)
    array = electrodes.needed(context.rig.status)
    own = channels.held(person, array.key)["profile"]
    asked = {**body.model_dump(), **laid(array, body)}
    for name, of in (("width_us", "max_pulse_width_us"), ("current_ma", "current_ma")):
        asked[name] = own.get(of, 0.0) if asked[name] is None else asked[name]
    electrodes.refuse_wider(own, asked["width_us"], asked["current_ma"])
    former = [one for one in await asyncio.to_thread(searches_of, context, code) if one.channel == array.channel]
    prior = next((one.document for one in former if one.state == "closed" and one.told), None)
    search = {
        **{name: asked[name] for name in ("wish", "width_us", "current_ma")},
        "positions_mm": electrodes.positions_mm(asked["rows"], asked["columns"], asked["pitch_mm"]),
        "farthest_mm": electrodes.FARTHEST_PITCHES * asked["pitch_mm"],
        "prior": prior and electrodes.shortened(prior, electrodes.EARLIER - 1),
    }
    found, now = await ask_worker(context, search=search), context.clock.utc()
    row = Search(id=f"E{now[:19].replace('-', '').replace(':', '')}-{secrets.token_hex(3)}", participant=code,
                 channel=array.channel, state="open", asked=asked, document=found["search"],
                 standing=found["standing"], told=[], created_by=who.name, created_utc=now)  # fmt: skip

    def write() -> None:
        with context.store.write() as session:
            session.add(row)
            audit.write(session, now, who.name, "begin search", code, search=row.id, **asked)

    await asyncio.to_thread(write)
    response.headers["Location"] = f"/v1/searches/{row.id}"
    return await standing(context, row)


@router.get("/participants/{code}/searches", **describe_answer(list[SearchOut]))
def list_searches(context: Ctx, _who: Tester, code: str) -> list[dict[str, Any]]:
    """A participant's searches, newest first."""
    participants.find(context, code)
    return [electrodes.document(context.store, row) for row in searches_of(context, code)]


@router.get("/searches/{search_id}", **describe_answer(SearchOut))
async def one_search(context: Ctx, _who: Tester, search_id: str, response: Response) -> dict[str, Any]:
    """A search: the map of all choices, the proposal, whether it is enough, each stimulus with what was seen."""
    row = await asyncio.to_thread(find, context, search_id)
    path, about = f"/v1/searches/{search_id}", electrodes.rests_of(row)
    response.headers["ETag"] = await asyncio.to_thread(context.store.etag, context.clock, path, *about)
    return await standing(context, row)


@router.post("/searches/{search_id}/stimuli", status_code=202, **describe_answer(SearchOut, 202, "it is on its way"))
async def play_stimulus(context: Ctx, who: Tester, search_id: str, body: PlayIn) -> dict[str, Any]:
    """Play one stimulus of a second; the next one only after it was told what this one gave."""
    row = await asyncio.to_thread(find, context, search_id)
    electrodes.refuse_closed(row)
    now = await standing(context, row)
    electrodes.refuse_untold(now)
    chosen = sorted(body.elements or now["proposal"]["elements"])
    refuse_unknown(now, chosen)
    stimulus = electrodes.StimulusIn(
        participant=row.participant, kind=electrodes.ELECTRODE, search_id=row.id, channel=row.channel,
        elements=chosen, width_us=now["width_us"], asked_ma=now["current_ma"],
    )  # fmt: skip
    await context.runner.start(stimulus, who.name, holder=who.token_hash)
    return await standing(context, row)


def refuse_unknown(now: dict[str, Any], elements: list[int]) -> None:
    """Raise ApiError (422) for what is no choice of this search."""
    if elements not in [one["elements"] for one in now["map"]]:
        detail = f"elements {elements}: give one of the array, or a pair that lies near each other."
        raise ApiError(422, "invalid-input", "This is no choice of the array", detail)


@router.post("/searches/{search_id}/seen", **describe_answer(SearchOut))
async def tell_seen(context: Ctx, who: Tester, search_id: str, body: SeenIn) -> dict[str, Any]:
    """Tell what the last stimulus gave: spill-over, and comfort as the participant says it."""
    row = await asyncio.to_thread(find, context, search_id)
    now = await standing(context, row)
    if now["waiting"] != body.test_id:
        detail = "Only the last stimulus is told, once it has ended by itself."
        raise ApiError(409, "not-waiting", "No answer is waited for", detail)
    last = now["stimuli"][-1]
    recording = await asyncio.to_thread(context.store.first, Recording, Recording.test_id == body.test_id)
    told = body.model_dump()
    stimulus = {**told, "elements": last["elements"], "recording": recording.path,
                "sign": 1.0 if now["direction"] == "flexion" else -1.0}  # fmt: skip
    told |= {"torque_nm": None, "by": who.name, "at_utc": context.clock.utc()}
    try:
        found = await ask_worker(context, search=row.document, stimulus=stimulus, left_out=now["left_out"])
    except ApiError as error:
        if error.status == 422:  # its recording says nothing: it is no evidence, and holds the search up no more
            same = {"search": row.document, "standing": row.standing}
            await asyncio.to_thread(put, context, row.id, len(row.told), same, [told])
        raise
    told["torque_nm"] = found["torque_nm"]
    return await standing(context, await asyncio.to_thread(put, context, row.id, len(row.told), found, [told]))


@router.post("/searches/{search_id}/choice", **describe_answer(SearchOut))
async def choose(context: Ctx, who: Tester, search_id: str, body: ChoiceIn) -> dict[str, Any]:
    """Close it with an electrode, which becomes the placement of its channel; choosing another one changes that."""
    row = await asyncio.to_thread(find, context, search_id)
    elements = sorted(body.elements)
    refuse_unknown(await standing(context, row), elements)
    return await standing(context, await _choose(context, row, elements, who.name, body.void_calibration))


def loses_calibration(person: Participant, key: str, placement: str) -> bool:
    """Whether this choice ends the calibration: it was found at another placement."""
    held = channels.held(person, key)
    return held["placement"] != placement and any(held["profile"].get(name) is not None for name in profiles.FOUND)


@in_limits_turn
def _choose(context: Context, row: Search, elements: list[int], by: str, voids: bool) -> Search:
    array, placement, now = electrodes.needed(context.rig.status), electrodes.words(elements), context.clock.utc()
    electrodes.refuse_other_channel(array, row.channel)
    participants.refuse_busy(context, row.participant)
    with context.store.write() as session:
        person, kept = participants.within(session, row.participant), session.get(Search, row.id)
        assert kept is not None
        seen.check(session, seen.participant(person.code))
        if not array.key:
            channels.refuse_reordered(person, context.rig.status)
        lost, own = loses_calibration(person, array.key, placement), channels.held(person, array.key)["profile"]
        if lost and not voids:
            before = site_of(person, array.key)[2] or "no element"
            detail = f"It was calibrated at {before}. To choose {placement}: void_calibration."
            raise ApiError(409, "voids-calibration", "This would make the calibration invalid", detail)
        profile = {**own, **dict.fromkeys(profiles.FOUND)} if lost else own
        channels.put(person, array.key, context.rig.status, placement=placement, profile=profile)
        kept.state, kept.chosen, kept.closed_by, kept.closed_utc = "closed", elements, by, now
        side, muscle, _ = site_of(person, array.key)
        said = {"side": side, "muscle": muscle, "placement": placement, "channel": array.channel, "search": row.id}
        audit.write(session, now, by, "set muscle", person.code, **said, voids_calibration=lost)
    return kept
