"""`stimrig export`: a cohort in a format of `api/exchange/outward`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.commands.cohort import (
    Columns,
    Given,
    Select,
    need_extra,
    passed_over,
    refuse_undone,
    telling,
)
from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.terminal import Json, say, say_json
from stimrig.api.exchange.outward import NAMES, writer


def export(
    data: Given,
    parquet: Annotated[Path | None, typer.Option(help="folder for Parquet files", show_default=False)] = None,
    bids: Annotated[Path | None, typer.Option(help="folder in the manner of BIDS", show_default=False)] = None,
    format: Annotated[str, typer.Option(help=f"one of {', '.join(NAMES)}, with -o", show_default=False)] = "",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="folder for it", show_default=False)] = None,
    select: Select = "",
    no_dates: Annotated[bool, typer.Option("--no-dates", help="leave out days and times")] = False,
    shift_days: Annotated[int, typer.Option(min=-80000, max=80000, help="move every day by so many days")] = 0,
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """Hand records on: Parquet, BIDS, NWB, FHIR, REDCap, MATLAB; one cut off goes on with the same command."""
    given = {name: value for name, value in locals().items() if name != "as_json"}
    found = exported(**given)
    say_json(found) if as_json else say(*report(found))
    refuse_undone(found["records"], found["errors"], f"{found['errors_file']} says of each why")


def exported(
    data: Sequence[str], parquet: Path | None = None, bids: Path | None = None, format: str = "",
    output: Path | None = None, select: str = "", no_dates: bool = False, shift_days: int = 0,
    columns: Sequence[str] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One export, and the keys of `--json`. Raises InputError, CommandError."""
    need_extra()
    made, folder = _format(parquet, bids, format, output)
    if no_dates and shift_days:
        raise InputError("give --no-dates or --shift-days, not both.")
    from stimrig.api.cohort.export import ERRORS, Days, Export
    from stimrig.api.cohort.export_state import State
    from stimrig.api.cohort.select import Selection
    from stimrig.api.cohort.sources import sources_of
    from stimrig.api.cohort.tasks import CutOffError

    selection, sources, mapped = Selection(select), sources_of(data), columns or []
    for source in sources:
        source.check()
    options = {"format": made.NAME, "hide": no_dates, "shift_days": shift_days, "columns": mapped}
    with closing(State(folder, options)) as state, telling() as tell:
        days = Days(no_dates, shift_days)
        try:
            told = Export(sources, selection, state, made, days, mapped, tell).go()
        except CutOffError as error:
            raise CommandError(f"{error}") from error
        return {
            "output": str(folder), "format": made.NAME, "records": state.count("done"),
            "errors": told.error, "written": told.ok, "done_before": told.before,
            "left_out": told.left_out, "copies": told.copies, "errors_file": str(folder / ERRORS),
        }  # fmt: skip


def _format(parquet: Path | None, bids: Path | None, format: str, output: Path | None) -> tuple[Any, Path]:
    """The format that is asked for, and its folder. Raises InputError: none, several, or one that there is not."""
    pairs = (("parquet", parquet), ("bids", bids), (format, output))
    given = [(name, folder) for name, folder in pairs if folder is not None]
    if len(given) != 1 or bool(format) != (output is not None):
        raise InputError(
            f"give --parquet FOLDER, --bids FOLDER, or --format ({', '.join(NAMES)}) with -o FOLDER; one of them."
        )
    ((name, folder),) = given
    try:
        return writer(name), folder
    except (LookupError, ImportError) as error:
        raise InputError(f"--format: {error.args[0]}") from None


def report(found: dict[str, Any]) -> list[str]:
    """What a person is told of an export."""
    lines = [f"records        {found['records']}: {found['written']} written now, {found['done_before']} done before"]
    if found["errors"]:
        lines.append(f"not exported   {found['errors']}; {found['errors_file']} says why")
    return [*lines, *passed_over(found, "exported"), f"written to     {found['output']}"]
