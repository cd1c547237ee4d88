"""`stimrig cohort`: one verb over many recordings, two runs compared, figures over a cohort.

Dask and pyarrow are an extra (`pip install stimrig[cohort]`): loaded where they are used, so that the verb can say so.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.cohort_report import changed_lines, run_lines, telling
from stimrig.api.cli.errors import CommandError, InputError
from stimrig.api.cli.terminal import Json, names, say, say_json, write

NEEDED = ("dask", "distributed", "pyarrow", "fsspec")
METHOD = "maximum-likelihood"
INTERRUPTED = 130

Given = Annotated[
    list[str],
    typer.Argument(
        help="files, folders, addresses that fsspec knows (s3://…), or a centre (https://…)",
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
Token = Annotated[str, typer.Option(help="of a centre", envvar="STIMRIG_TOKEN", show_envvar=True, show_default=False)]
Columns = Annotated[
    list[str] | None,
    typer.Option("--map", help="columns of another tool's files, as in `stimrig fit`", show_default=False),
]


RUNS = {
    "fit": ("Fit a model to every selected record; one row each in Parquet.", ()),
    "diagnose": (
        "What is missing in the plain structure, for every selected record; one row each in Parquet.",
        ("method", "effects"),
    ),
    "improve": (
        "Add effects as long as the evidence lasts, for every selected record; one row each in Parquet.",
        ("method", "effects"),
    ),
}
"""What each verb over records does, and the options of `run` that it lacks."""


def register(app: typer.Typer) -> None:
    """Add the verb and what it can do."""
    verbs = typer.Typer(no_args_is_help=True, help="Fit or diagnose many recordings, compare two runs, draw a cohort.")
    for verb, (words, lacks) in RUNS.items():
        verbs.command(verb, help=words)(run_of(verb, lacks))
    for command in (changed, figures):
        verbs.command(command.__name__)(command)
    app.add_typer(verbs, name="cohort")


def run_of(verb: str, lacks: tuple[str, ...]) -> Callable[..., None]:
    """`run` with one verb, as the command line sees it: with the options that the verb has."""
    whole = inspect.signature(run, eval_str=True)
    options = [option for name, option in whole.parameters.items() if name not in ("verb", *lacks)]

    def command(**given: Any) -> None:
        run(verb, **given)

    command.__signature__ = whole.replace(parameters=options)  # pyright: ignore[reportFunctionMemberAccess]
    return command


def run(
    verb: str,
    data: Given,
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
    renew: Annotated[
        int, typer.Option(min=1, help="after so many records a worker's computing process is started anew")
    ] = 500,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Dask's dashboard on this machine; its address is shown")
    ] = False,
    wait: Annotated[
        float, typer.Option(min=0.1, help="with --scheduler: how long to wait for its first worker, s")
    ] = 60.0,
    again: Annotated[
        bool, typer.Option("--again", help="do anew what timed out, was killed or could not be read")
    ] = False,
    token: Token = "",
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """One run."""
    need_extra()
    from stimrig.api.cohort import cluster
    from stimrig.api.cohort.errors import CutOffError
    from stimrig.api.cohort.parts import Results as Table
    from stimrig.api.cohort.run import Run
    from stimrig.api.cohort.select import Selection
    from stimrig.api.cohort.sources.addresses import sources_of
    from stimrig.api.cohort.tasks import Task, checked
    from stimrig.api.cohort.worker import Bounds
    from stimrig.api.version import software_version

    given = (verb, Selection(select).text, method, names(effects), tuple(columns or ()), software_version())
    task = checked(Task(*given))
    place = cluster.Workers(scheduler, workers, cluster.memory_of(memory), dashboard, wait)
    sources = sources_of(data, token, place.scheduler)
    bounds = Bounds(limit, place.memory_bytes, renew)
    for source in sources:
        source.check()
    began_s = time.monotonic()
    try:
        with Table(output, task, again) as results, cluster.connected(place) as client:
            link = str(client.dashboard_link) if place.dashboard or place.scheduler else ""
            with telling(link) as tell:
                tally = Run(client, sources, task, bounds, results, tell).go()
            counts = results.join()
    except CutOffError as error:
        raise CommandError(str(error)) from error
    except KeyboardInterrupt:
        raise CommandError("interrupted. What is done is kept; the same command goes on.", INTERRUPTED) from None
    if tally.left_open:
        print(
            f"stimrig cohort: workers could not be shut in: {tally.left_open}. See `stimrig doctor` there.",
            file=sys.stderr,
        )
    found = {
        "output": str(output),
        "records": counts["ok"] + counts["error"],
        "ok": counts["ok"],
        "errors": counts["error"],
        "computed": tally.ok + tally.error,
        "done_before": tally.before,
        "left_out": tally.left_out,
        "copies": tally.copies,
        "took_s": round(time.monotonic() - began_s, 1),
    }
    say_json(found) if as_json else say(*run_lines(found))


def changed(
    old: Annotated[Path, typer.Argument(metavar="OLD.parquet", show_default=False)],
    new: Annotated[Path, typer.Argument(metavar="NEW.parquet", show_default=False)],
    as_json: Json = False,
) -> None:
    """Whose results differ between two runs, and why: what a new release is judged by before it is used on people."""
    need_extra()
    from stimrig.api.cohort.changed import compared

    found = compared(old, new).to_dict()
    say_json(found) if as_json else say(*changed_lines(found))


def figures(
    results: Annotated[Path, typer.Argument(metavar="RESULTS.parquet", show_default=False)],
    html: Annotated[Path, typer.Option("-o", "--html", help="file to write: works offline, in any browser")],
    as_json: Json = False,
) -> None:
    """Draw a cohort: effects by prevalence, parameters over sessions, repeatability, errors by reason."""
    need_extra()
    from stimrig.api.cohort import drawn, page
    from stimrig.api.cohort.gathered import gather

    found = gather(results)
    write(html, page.html(found, results.name))
    of_what, total, counts = found.prevalence()
    if as_json:
        say_json({
            "output": str(html), "records": found.records, "ok": found.ok, "errors": dict(found.errors),
            "participants": len(found.people), "verdicts": dict(found.verdicts), "counted": of_what, "of": total,
            "effects": dict(counts), "repeatability": drawn.repeats(found),
        })  # fmt: skip
        return
    say(f"{found.records} records, {found.ok} with a result, {len(found.people)} participants", f"written to {html}")


def need_extra() -> None:
    """Refuse without the extra.

    Raises
    ------
    InputError
        A package is missing.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"needs `pip install stimrig[cohort]` ({', '.join(missing)} is missing)")
