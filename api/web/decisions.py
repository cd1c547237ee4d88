"""The one door of what people and programs decide: each decision says on which version it was made."""

from __future__ import annotations

import re
from contextlib import suppress

from fastapi import Request

from stimrig.api import decisions
from stimrig.api.clock import local_day
from stimrig.api.decisions import MODEL_TAG, OF_RIG, Decision
from stimrig.api.errors import ApiError
from stimrig.api.sessions.requests import PARTICIPANT_CODE
from stimrig.api.store import seen
from stimrig.api.web.headers import entity_tags
from stimrig.api.web.strict_body import PARSED

MOST_TAGS = 20
"""Of `If-Match`: the others are not read."""


async def take(request: Request) -> None:
    """Note what the request was decided on, for `stimrig.api.store.seen.check`.

    Raises
    ------
    ApiError
        428: it does not say; 409: another day has begun since, or what it says is no version.
    """
    found = decisions.find(request.method, request.url.path)
    if found is None:
        return
    decision, names = found
    document = decision.document.format(**{**await _names(request, decision), **names})
    text, marks = await _sent(request, decision, seen.mark_of(document))
    if decision.field == "latch" and not request.app.state.context.rig.latch_known:
        raise old_rig()
    if not decision.needed and request.url.path.startswith("/v1/") and "if-match" not in request.headers:
        return
    seen.today.set(lambda: local_day(request.app.state.context.clock.utc()))
    if not re.fullmatch(r"[\w.-]{1,120}", text, re.ASCII):
        raise missing(document, decision)
    seen.sent.set(text)
    place = seen.read(text, *marks)
    if decision.field in OF_RIG or (decision.path == "/v1/tests" and len(text) == MODEL_TAG):
        return
    if place is None:
        raise seen.another_document(document)
    seen.refuse_another_day(place)
    seen.shown.set(place)


async def _names(request: Request, decision: Decision) -> dict[str, str]:
    """What a request's body names of the document: a test's participant."""
    code = "{code}"
    if decision.path == "/v1/tests" and request.url.path == decision.path:
        await request.body()
        with suppress(KeyError, TypeError):  # the route says what is wrong with it
            said = request.scope[PARSED]["participant"]
            code = said if isinstance(said, str) and re.fullmatch(PARTICIPANT_CODE, said, re.ASCII) else code
    return {"code": code}


async def _sent(request: Request, decision: Decision, mark: str) -> tuple[str, tuple[str, ...]]:
    """The version, as `If-Match` or the form's field has it, and the marks that it may have: a page's has none.

    Of several the newest of this document.
    """
    fields = request.headers.getlist("if-match")
    if fields:
        tags = [tag.strip('"') for field in fields for tag in entity_tags(field)][:MOST_TAGS]
        places = {place.entry: tag for tag in tags if (place := seen.read(tag, mark))}
        return (places[max(places)] if places else tags[0]), (mark,)
    if "form" not in request.headers.get("content-type", ""):
        return "", (mark,)
    return str((await request.form()).get(decision.field) or ""), ("", mark)


def old_rig() -> ApiError:
    """409: the rig says nothing by which a stop could be named."""
    detail = "Its program does not say which stop it stands at. Update and restart the rig's program; then re-arm."
    return ApiError(409, "rig-outdated", "The rig's program is older than this service", detail)


def missing(document: str, decision: Decision) -> ApiError:
    """428: nobody says what this was decided on (RFC 6585, section 3)."""
    trial = f" (a controller's key: of GET {document}/model)" if decision.path == "/v1/tests" else ""
    detail = (
        f"Send the ETag of GET {document}{trial} as If-Match, as you last saw it. On a page: load it again and repeat "
        "what you did. Nothing was done."
    )
    return ApiError(428, "seen-missing", "Say what this was decided on", detail)
