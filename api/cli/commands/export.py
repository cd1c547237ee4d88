"""`stimrig export`: many records, each as one CSV, MAT or Parquet file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.commands.cohort import Addresses, Columns, Select, refuse_undone
from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import listed, report
from stimrig.api.export.record_file import WRITERS


def export(
    data: Addresses,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write, new or empty", show_default=False)],
    format: Annotated[str, typer.Option(help=f"one of {', '.join(WRITERS)}")] = "csv",
    select: Select = "",
    no_dates: Annotated[bool, typer.Option("--no-dates", help="leave out days, times and what a person typed")] = False,
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """Write records as CSV, MAT or Parquet, one file each, with a table of them."""
    from stimrig.api.export.folder import export_records

    document = export_records(data, output, format, select, columns or (), dates=not no_dates)
    report(document, as_json, *listed(document))
    refuse_undone(document["records"], document["errors"], f"{document['errors_file']} says of each why")
