"""`stimrig explain`: compare, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig import identify
from stimrig.api.cli.commands.diagnose import add_command, begin_with, test_command
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import check_outputs, html_report, load_structure, make_folder, short, story_of, write
from stimrig.api.cli.options import ColumnMap, HeldModel, Json, LastModel, SeveralData
from stimrig.api.cli.terminal import print_aside, report
from stimrig.api.progress_bar import progress_bar


def explain(
    data: SeveralData,
    model_json: HeldModel = None,
    html: Annotated[Path | None, typer.Option(help="write the story with its figures here, one file")] = None,
    figures: Annotated[Path | None, typer.Option(help="write each figure as SVG, PDF and PNG into this folder")] = None,
    own: Annotated[
        Path | None, typer.Option(help="write the first free effect, if any, as an own effect here, a .py file")
    ] = None,
    output: LastModel = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Explain a model's error step by step: where it fails, the missing effects, the error with them, and what is left.

    Takes 5 to 60 s; up to three minutes where structure is left, with several recordings, or on a busy computer.

    Without -o no model is kept.
    """
    if own is not None and own.suffix != ".py":
        raise InputError(f"--own {own}: give a name that ends in .py.")
    if own is not None and own.exists():
        raise InputError(f"--own {own}: it exists already: move it or give another name.")
    drawn = []
    if figures is not None:
        from stimrig.api.charts.diagnosis_charts import story_names
        from stimrig.api.charts.figure import FILE_KINDS

        drawn = [figures / f"{name}.{kind}" for name in story_names() for kind in FILE_KINDS]
    check_outputs([*data, model_json], output, html, own, *drawn, new_folder=figures)
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        explained = identify.explain(record, progress, model)
    if figures is not None:
        make_folder(figures)
    write(output, explained.improvement.models[-1])
    if html is not None:
        write(html, html_report(explained, record, short(data)))
    if figures is not None:
        from stimrig.api.charts.diagnosis_charts import story_figures
        from stimrig.api.charts.figure import FILE_KINDS

        narrative = story_of(record, explained)
        for name, figure in story_figures(narrative["story"], narrative["before"], narrative["after"]).items():
            for kind in FILE_KINDS:
                write(figures / f"{name}.{kind}", figure.file(kind))
    document = {"structure": structure, **explained.to_dict()}
    commands = [f"`stimrig explain {begin_with(model_json)}DATA -o NEW.json` writes the last model."]
    if output is not None:
        commands = add_command(explained.left, output)
    commands += test_command(explained.left, model_json)
    report(document, as_json, explained, *commands, files=[output, html, figures])
    if own is not None:
        from stimrig.api.export.own_effect import own_effect

        try:
            write(own, own_effect(explained.improvement.models[-1]))
            print_aside(f"own effect written to {own}")
        except identify.BadRequest as error:  # a finding about the record; the other outputs are as asked for
            print_aside(f"{own} is not written: {error.message}")
