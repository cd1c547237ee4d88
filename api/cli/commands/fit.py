"""`stimrig fit`: identify a model from a record."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from api.cli.terminal import (
    ColumnMap,
    Data,
    Json,
    load_record,
    model_report,
    names,
    say,
    say_json,
    write_model,
)
from api.progress_bar import progress_bar


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("fit")(fit)


def fit(
    data: Data,
    method: Annotated[
        str,
        typer.Option(help="maximum-likelihood, two-stage, ramp-deconvolution, separable-least-squares or narx"),
    ] = "maximum-likelihood",
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
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write MODEL.json, or MODEL.mat")] = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Identify a model: recruitment curve, linear dynamics, effects. Says how well it fits and whether it is usable."""
    import identify

    record = load_record(data, columns)
    with progress_bar() as progress:
        model = identify.fit(
            record, method=method, effects=names(effects), fit_on=names(fit_on) or None, progress=progress
        )
    if output is not None:
        write_model(output, model)
    if as_json:
        say_json(model.to_dict())
        return
    say(*model_report(model.to_dict()), *([f"written to     {output}"] if output else []))
