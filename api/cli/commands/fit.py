"""`stimrig fit`: identify a model from a record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import check_outputs, load_model, load_record, write
from stimrig.api.cli.options import ColumnMap, Json, SeveralData, names
from stimrig.api.cli.terminal import report
from stimrig.api.progress_bar import progress_bar

METHOD = "maximum-likelihood"


def fit(
    data: SeveralData,
    method: Annotated[
        str,
        typer.Option(help="maximum-likelihood, two-stage, ramp-deconvolution, separable-least-squares or narx"),
    ] = METHOD,
    effects: Annotated[
        str,
        typer.Option(
            help="effects of the model, comma-separated (`stimrig effects` lists them), each `id` or "
            "`id:form`; or `auto`: those that the record asks for, as `improve` adds them. Only with maximum-likelihood"
        ),
    ] = "",
    fit_on: Annotated[
        str,
        typer.Option(
            help="segments to fit on, comma-separated, never `validate`; default: all others, or what the method needs"
        ),
    ] = "",
    carry: Annotated[
        Path | None,
        typer.Option(
            help="fit this earlier model's structure, too, with those of its effects that DATA asks for; the result is "
            "the better one of it and the plain structure. Not with --method, --effects, --fit-on",
            metavar="MODEL.json",
            show_default=False,
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write MODEL.json")] = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Identify a model: recruitment curve, linear dynamics, effects. Says how well it fits and whether it is usable."""
    if carry is not None and (method != METHOD or effects or fit_on):
        raise InputError("--carry takes the structure of its MODEL.json. Leave out --method, --effects and --fit-on.")
    check_outputs([*data, carry], output)
    earlier = None if carry is None else load_model(carry)
    record = load_record(data, columns, names(effects))
    carried = None
    with progress_bar() as progress:
        if earlier is None:
            model = identify.fit(
                record, method=method, effects=names(effects), fit_on=names(fit_on) or None, progress=progress
            )
        else:
            carried = identify.carry(record, earlier, progress)
            model = carried.model.with_(extra=carried.model.extra | {"carried": carried.finding()})
    write(output, model)
    report(model.to_dict(), as_json, model, *filter(None, [carried]), files=[output])
