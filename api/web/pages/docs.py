"""The API's description as a page, drawn by Swagger UI from files of this machine."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

from api.web.pages.environment import environment

router = APIRouter(include_in_schema=False)


@router.get("/docs")
def docs() -> HTMLResponse:
    """Every route, with what it takes and gives; it sends no request but GET: nothing is started by reading."""
    return HTMLResponse(environment.get_template("docs.html").render())
