"""A reference torque as a file: what the model predicts for it, what is out of reach, the widths to take away."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import PlainTextResponse, Response

from stimrig.api.charts.drawing import svg
from stimrig.api.charts.model_charts import inversion
from stimrig.api.errors import ApiError
from stimrig.api.models import inverted as words
from stimrig.api.store.tables import Model
from stimrig.api.web.dependencies import Context, Ctx, ModelReader, Version
from stimrig.api.web.pages.render import page
from stimrig.api.web.routes.models import invert as find_widths

router = APIRouter(include_in_schema=False, prefix="/models/{model_id}")


@router.get("/widths")
async def show(request: Request, context: Ctx, _who: ModelReader, row: Version) -> Response:
    """The form."""
    return await render_widths(request, context, row)


@router.post("/widths")
async def invert(
    request: Request, context: Ctx, _who: ModelReader, row: Version, file: Annotated[UploadFile | None, File()] = None
) -> Response:
    """The widths for a reference that was sent; what is wrong with it stands above the form."""
    table = text_of(await file.read()) if file is not None else ""
    try:
        found = await find_widths(context, row.id, {"table": table})
    except ApiError as error:
        if error.status != 422:
            raise
        return await render_widths(request, context, row, problem=error)
    return await render_widths(request, context, row, found, file.filename if file else "")


@router.post("/widths.csv")
async def download(context: Ctx, _who: ModelReader, model_id: str, reference: Annotated[str, Form()] = "") -> Response:
    """The same as a table: time, pulse width, reference, prediction."""
    found = await find_widths(context, model_id, {"table": reference})
    headers = {"Content-Disposition": 'attachment; filename="widths.csv"'}
    return PlainTextResponse(words.table(found), media_type="text/csv; charset=utf-8", headers=headers)


def text_of(content: bytes) -> str:
    """The text of a file; one that holds other bytes is read by no tool as the table it should be."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


async def render_widths(
    request: Request, context: Context, row: Model, found: dict[str, Any] | None = None, name: str | None = None,
    problem: ApiError | None = None,
) -> Response:  # fmt: skip
    """The page, with the result where there is one."""
    version = await asyncio.to_thread(context.versions.document, row)
    picture, lacking, pulses = None, [], ""
    if found is not None:
        label = "Reference and predicted torque, and pulse width, over time; shaded where it is out of reach"
        picture, lacking = svg(inversion(found), 1160.0, 460.0, label), words.rows(found["unreachable"])
        pulses = "torque_nm\n" + "\n".join(f"{torque:g}" for torque in found["reference_torque_nm"])
    return page(
        request, "widths.html", 422 if problem else 200, model=version, found=found, drawn=picture, lacking=lacking,
        pulses=pulses, problem=problem, file_name=name,
    )  # fmt: skip
