"""`stimrig cohort`: one verb over many recordings.

Its packages are an extra (`pip install stimrig[cohort]`): loaded where they are used, so that the verb can say so.
"""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.commands.fit import METHOD
from stimrig.api.cli.errors import INTERRUPTED, CommandError, InputError
from stimrig.api.cli.options import Json, names
from stimrig.api.cli.terminal import say, say_json

NEEDED = ("dask", "distributed", "fsspec", "pyarrow")

Addresses = Annotated[
    list[str],
    typer.Argument(
        help="files, folders, addresses that fsspec knows (s3://…)",
        metavar="DATA…",
        show_default=False,
    ),
]
Select = Annotated[
    str,
    typer.Option(
        help='which records, as \'participant in ("P001", "P002") and day >= "2026-01-01"\'; default: all '
        "(docs/cohorts.md lists the fields)"
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--map", help="columns of another tool's files, as in `stimrig fit`", show_default=False),
]

RUNS = {
    "fit": "Fit a model to every selected record; one row each in Parquet.",
    "diagnose": "What is missing in the plain structure, for every selected record; one row each in Parquet.",
    "improve": "Add effects as long as the evidence lasts, for every selected record; one row each in Parquet.",
}


def register(app: typer.Typer) -> None:
    """Add the verb and its verbs."""
    verbs = typer.Typer(no_args_is_help=True, help="Fit, diagnose or improve many recordings.")
    for verb, help_text in RUNS.items():
        verbs.command(verb, help=help_text)(_run_of(verb))
    app.add_typer(verbs, name="cohort")


def _run_of(verb: str) -> Callable[..., None]:
    """Return `run` for one verb, with the options that the verb has."""
    signature = inspect.signature(run, eval_str=True)
    without = ("verb",) if verb == "fit" else ("verb", "method", "effects")
    options = [option for name, option in signature.parameters.items() if name not in without]

    def command(**options: Any) -> None:
        run(verb, **options)

    command.__signature__ = signature.replace(parameters=options)  # pyright: ignore[reportFunctionMemberAccess]
    return command


def run(
    verb: str,
    data: Addresses,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="results (Parquet); a run that is cut off goes on with the same command"),
    ],
    select: Select = "",
    method: Annotated[str, typer.Option(help="as in `stimrig fit`")] = METHOD,
    effects: Annotated[str, typer.Option(help="effects of the models, comma-separated, or `auto`")] = "",
    scheduler: Annotated[
        str, typer.Option(help="address of a Dask scheduler, as tcp://host:8786; default: processes of this machine")
    ] = "",
    workers: Annotated[int, typer.Option(min=1, max=1024, help="processes on this machine, one thread each")] = 2,
    memory: Annotated[str, typer.Option(help="what a record may take beyond the libraries")] = "1GB",
    limit: Annotated[
        float, typer.Option(min=1.0, max=86400.0, help="what a record may take, s; then it is a row")
    ] = 600.0,
    wait: Annotated[
        float, typer.Option(min=0.1, help="with --scheduler: how long to wait for its first worker, s")
    ] = 60.0,
    again: Annotated[
        bool, typer.Option("--again", help="do anew what timed out, was killed or could not be read")
    ] = False,
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """Do one verb with every record."""
    require_extra()
    from stimrig.api.cohort.errors import RESUMABLE, InterruptedRunError
    from stimrig.api.cohort.run import run_cohort

    try:
        report = run_cohort(
            verb, data, output, select=select, method=method, effects=names(effects), scheduler=scheduler,
            workers=workers, memory=memory, limit=limit, wait=wait, again=again, columns=columns,
        )  # fmt: skip
    except InterruptedRunError as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        raise CommandError(f"interrupted. {RESUMABLE}", INTERRUPTED) from None
    say_json(report) if as_json else say(*_run_lines(report))
    refuse_undone(report["ok"], report["errors"], f"{output} says of each why")


def refuse_undone(done: int, failed: int, where: str) -> None:
    """Raise CommandError after the report, where not all of what was asked for was done."""
    nothing = "" if done else "nothing was done: "
    if failed:
        raise CommandError(f"{nothing}{failed} of {done + failed} records gave no result: {where}.")
    if nothing:
        raise CommandError(f"{nothing}no record was selected.")


def require_extra() -> None:
    """Raise InputError if a package of the extra is missing."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"needs `pip install stimrig[cohort]` ({', '.join(missing)} is missing)")


def _run_lines(report: dict[str, Any]) -> list[str]:
    lines = [
        f"records        {report['records']}: {report['ok']} with a result, {report['errors']} without "
        "(column `error` says why)",
        f"this run       {report['computed']} computed, {report['done_before']} done before, {report['took_s']:g} s",
        *skipped_lines(report, "counted"),
    ]
    if not report["records"] + report["left_out"]:
        lines.append("Nothing was found. A folder is searched for .h5, .hdf5, .csv, .tsv, .txt and .mat files.")
    return [*lines, f"written to     {report['output']}"]


def skipped_lines(report: dict[str, Any], verb: str) -> list[str]:
    """Describe records that were not selected, and files whose content was there already."""
    left_out, copies = report["left_out"], report["copies"]
    lines = [f"left out       {left_out} that --select does not mean"] if left_out else []
    return lines + ([f"copies         {copies} files with the content of another: {verb} once"] if copies else [])
