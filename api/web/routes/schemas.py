"""JSON Schemas of MODEL.json and of what `stimrig` prints with `--json`."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse

from stimrig.api import schemas
from stimrig.api.errors import NotFoundError
from stimrig.api.web.openapi import problem
from stimrig.api.web.responses.base import SchemaOut, SchemasOut, answers

router = APIRouter(prefix="/v1/schemas", tags=["schemas"])
FOUND: dict[int | str, dict[str, Any]] = {
    200: {"model": SchemaOut, "description": "the schema"},
    404: problem("no schema of this name"),
}


class SchemaResponse(JSONResponse):
    """An answer that says that it is a schema."""

    media_type = "application/schema+json"


@router.get("", **answers(SchemasOut))
def published() -> dict[str, Any]:
    """The schemas there are, by name, with their ids; an id ends in the version."""
    return {"schemas": {name: schemas.load(name)["$id"] for name in schemas.NAMES}}


@router.get("/{name}", response_class=SchemaResponse, response_model=None, responses=FOUND)
def schema(name: str) -> JSONResponse:
    """One schema, by its name or by the verb that prints it."""
    try:
        return SchemaResponse(schemas.load(name))
    except KeyError:
        raise NotFoundError("schema", name, f"There are {', '.join(schemas.NAMES)}.") from None
