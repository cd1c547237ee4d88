"""`stimrig export`: many records, each as one CSV, MAT or Parquet file."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.commands.cohort import Columns, Given, Select, refuse_undone, skipped_lines
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import say, say_json
from stimrig.api.export.record_file import WRITERS


def export(
    data: Given,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write, new or empty", show_default=False)],
    format: Annotated[str, typer.Option(help=f"one of {', '.join(WRITERS)}")] = "csv",
    select: Select = "",
    no_dates: Annotated[bool, typer.Option("--no-dates", help="leave out days, times and what a person typed")] = False,
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """Write records as CSV, MAT or Parquet, one file each, with a table of them."""
    found = exported(data, output, format, select, no_dates, columns)
    say_json(found) if as_json else say(*report(found))
    refuse_undone(found["records"], found["errors"], f"{found['errors_file']} says of each why")


def exported(
    data: Sequence[str], output: Path, format: str = "csv", select: str = "", no_dates: bool = False,
    columns: Sequence[str] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Export records; return the keys of `--json`. Raises InputError, CohortError."""
    if format not in WRITERS:
        raise InputError(f"--format {format}: no such format. Give one of {', '.join(WRITERS)}.")
    if format == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise InputError("--format parquet: pyarrow is missing. Install it: pip install pyarrow.")
    from stimrig.api.cohort.select import Selection
    from stimrig.api.export.folder import ERRORS, export_records
    from stimrig.identify.records.columns import parsed

    parsed(columns)  # refused before the folder is made
    return {
        "output": str(output),
        "format": format,
        **export_records(data, Selection(select), output, format, columns or (), dates=not no_dates),
        "errors_file": str(output / ERRORS),
    }


def report(found: dict[str, Any]) -> list[str]:
    """Say an export for people."""
    lines = [f"records        {found['records']}, listed in {Path(found['output']) / 'records.csv'}"]
    if found["errors"]:
        lines.append(f"not exported   {found['errors']}; {found['errors_file']} says why")
    return [*lines, *skipped_lines(found, "exported"), f"written to     {found['output']}"]
