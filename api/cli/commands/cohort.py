"""`stimrig cohort`: fit, diagnose or improve many recordings.

Its packages are an extra (`pip install stimrig[cohort]`): loaded where they are used, so that the verb can say so.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Literal

import typer

from stimrig.api.cli.commands.fit import METHOD
from stimrig.api.cli.errors import INTERRUPTED, CommandError, InputError
from stimrig.api.cli.files import check_outputs
from stimrig.api.cli.options import Json, names
from stimrig.api.cli.terminal import listed, report

SEARCHED = ".h5, .hdf5, .csv, .tsv, .txt and .mat"
NEEDED = ("dask", "distributed", "fsspec", "pyarrow")

Verb = Literal["fit", "diagnose", "improve"]
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


def cohort(
    verb: Annotated[Verb, typer.Argument(help="what is done with each record")],
    data: Addresses,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="results (Parquet); a run that is cut off goes on with the same command"),
    ],
    select: Select = "",
    method: Annotated[str, typer.Option(help="of `cohort fit`, as in `stimrig fit`")] = METHOD,
    effects: Annotated[
        str, typer.Option(help="of `cohort fit`: effects of the models, comma-separated, or `auto`")
    ] = "",
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
    """Fit a model to every selected record, diagnose the plain structure, or add effects; one row each in Parquet."""
    require_extra()
    from stimrig.api.cohort.errors import RESUMABLE, InterruptedRunError
    from stimrig.api.cohort.run import run_cohort

    if verb != "fit" and (method != METHOD or effects):
        raise InputError(f"--method and --effects are options of `cohort fit`: {verb} begins with the plain structure.")
    check_outputs(map(Path, data), output)
    try:
        document = run_cohort(
            verb, data, output, select=select, method=method, effects=names(effects), scheduler=scheduler,
            workers=workers, memory=memory, limit=limit, wait=wait, again=again, columns=columns,
        )  # fmt: skip
    except InterruptedRunError as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        raise CommandError(f"interrupted. {RESUMABLE}", INTERRUPTED) from None
    report(document, as_json, *listed(document))
    refuse_undone(document["ok"], document["errors"], f"column `error` of {output} says of each why")


def refuse_undone(done: int, failed: int, where: str) -> None:
    """Raise CommandError after the report, where not all of what was asked for was done."""
    nothing = "" if done else "nothing was done: "
    if failed:
        raise CommandError(f"{nothing}{failed} of {done + failed} records gave no result: {where}.")
    if nothing:
        raise CommandError(f"{nothing}no record was selected. Folders are searched for {SEARCHED} files.")


def require_extra() -> None:
    """Raise InputError if a package of the extra is missing."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"needs `pip install stimrig[cohort]` ({', '.join(missing)} is missing)")
