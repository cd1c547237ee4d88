"""Every error that a client can meet, as RFC 9457 ``application/problem+json``: one table of exceptions."""

from __future__ import annotations

import logging
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from sqlalchemy.exc import DataError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from stimrig.api.errors import ApiError, invalid, not_answering
from stimrig.api.web.middleware import wants_html
from stimrig.api.web.pages.render import identify_viewer, problem_page

log = logging.getLogger("stimrig.api")


def from_validation(error: RequestValidationError) -> ApiError:
    """List the fields that do not hold, each with what would do."""
    fields = []
    for item in error.errors():
        if item["type"] == "json_invalid":
            where = item["loc"][-1]
            return invalid(f"The body is no JSON from character {where} on. Send one whole JSON object in UTF-8.")
        place = ".".join(str(part) for part in item.get("loc", ()) if part != "body") or "body"
        text = repr(item.get("input"))
        got = text if len(text) <= 80 else text[:77] + "..."
        fields.append({"field": place, "detail": str(item.get("msg", "")), "got": got})
    return invalid("; ".join(f"{field['field']}: {field['detail']}" for field in fields), errors=fields)


HTTP_DETAILS = {
    404: "There is nothing at this address. /openapi.json lists what there is.",
    405: "The address is right, the method is not. /openapi.json lists what there is.",
}


def from_http(error: HTTPException) -> ApiError:
    """Give Starlette's own refusals a code and a detail."""
    phrase, detail = HTTPStatus(error.status_code).phrase, HTTP_DETAILS.get(error.status_code, str(error.detail))
    problem = ApiError(error.status_code, phrase.lower().replace(" ", "-"), phrase, detail)
    problem.headers = dict(error.headers or {})
    return problem


LOGGED = "Nothing was lost. The service's log (logs/api.log in the data folder) says more."
PROBLEMS: dict[type[Exception], Callable[[Any], ApiError]] = {
    ApiError: lambda error: error,
    RequestValidationError: from_validation,
    HTTPException: from_http,
    OperationalError: lambda _error: not_answering(),
    InterfaceError: lambda _error: not_answering(),
    PoolTimeout: lambda _error: not_answering(),
    DataError: lambda error: invalid(f"The database takes no such value: {str(error.orig).splitlines()[0]}"),
    ClientDisconnect: lambda _error: ApiError(400, "left", "The request was not complete"),
    Exception: lambda _error: ApiError(500, "internal", "Something unexpected went wrong here", LOGGED),
}


async def respond(request: Request, error: Exception) -> Response:
    """Answer with the problem as JSON, or as a page where a browser asked."""
    problem = next(PROBLEMS[kind] for kind in type(error).__mro__ if kind in PROBLEMS)(error)
    path = getattr(request.scope.get("route"), "path", "?")  # without the participant that the address may name
    if problem.code in ("internal", "database"):
        log.error("%s %s: %s", request.method, path, error, exc_info=error if problem.code == "internal" else None)
    elif isinstance(error, ClientDisconnect):
        log.info("%s %s: the client left before the whole request was here", request.method, path)
    if wants_html(request):
        await identify_viewer(request)
        return problem_page(request, problem)
    body = problem.body(str(request.url.path))
    return JSONResponse(body, problem.status, problem.headers, "application/problem+json")
