"""`stimrig export`: many records, each as one CSV, MAT or Parquet file."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.commands.cohort import Addresses, Columns, Select, refuse_undone, skipped_lines
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import say, say_json
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
    report = exported(data, output, format, select, no_dates, columns)
    say_json(report) if as_json else say(*_report_lines(report))
    refuse_undone(report["records"], report["errors"], f"{report['errors_file']} says of each why")


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


def _report_lines(report: dict[str, Any]) -> list[str]:
    lines = [f"records        {report['records']}, listed in {Path(report['output']) / 'records.csv'}"]
    if report["errors"]:
        lines.append(f"not exported   {report['errors']}; {report['errors_file']} says why")
    return [*lines, *skipped_lines(report, "exported"), f"written to     {report['output']}"]
