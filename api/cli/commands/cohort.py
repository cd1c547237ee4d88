"""`stimrig cohort`: one verb over many recordings, two runs compared, figures over a cohort.

Dask and pyarrow are an extra (`pip install stimrig[cohort]`): loaded where they are used, so that the verb can say so.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stimrig.api.cli.commands.fit import METHOD
from stimrig.api.cli.errors import INTERRUPTED, CommandError, InputError
from stimrig.api.cli.terminal import Json, names, say, say_json, table, write
from stimrig.api.progress_bar import in_notebook, progress_bar

if TYPE_CHECKING:
    from stimrig.api.cohort.tally import Tally

NEEDED = ("dask", "distributed", "pyarrow", "fsspec")

Given = Annotated[
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
    wait: Annotated[
        float, typer.Option(min=0.1, help="with --scheduler: how long to wait for its first worker, s")
    ] = 60.0,
    again: Annotated[
        bool, typer.Option("--again", help="do anew what timed out, was killed or could not be read")
    ] = False,
    columns: Columns = None,
    as_json: Json = False,
) -> None:
    """One run."""
    given = {name: value for name, value in locals().items() if name != "as_json"}
    found = computed(**given)
    say_json(found) if as_json else say(*run_lines(found))
    refuse_undone(found["ok"], found["errors"], f"{output} says of each why")


def computed(
    verb: str, data: Sequence[str], output: Path, *, select: str = "", method: str = METHOD, effects: str = "",
    scheduler: str = "", workers: int = 2, memory: str = "1GB", limit: float = 600.0, renew: int = 500,
    wait: float = 60.0, again: bool = False, columns: Sequence[str] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One run, and the keys of `--json`. Raises InputError, CommandError."""
    need_extra()
    from stimrig.api.cohort import cluster
    from stimrig.api.cohort.computing import Bounds
    from stimrig.api.cohort.results import Results as Table
    from stimrig.api.cohort.run import Run
    from stimrig.api.cohort.select import Selection
    from stimrig.api.cohort.sources import sources_of
    from stimrig.api.cohort.tasks import CutOffError, Task, checked
    from stimrig.api.version import software_version

    given = (verb, Selection(select).text, method, names(effects), tuple(columns or ()), software_version())
    task = checked(Task(*given))
    place = cluster.Workers(scheduler, workers, cluster.memory_of(memory), wait)
    sources = sources_of(data)
    bounds = Bounds(limit, place.memory_bytes, renew)
    for source in sources:
        source.check()
    began_s = time.monotonic()
    try:
        with Table(output, task, again) as results, cluster.connected(place) as client:
            with telling() as tell:
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
    return {
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


def refuse_undone(done: int, failed: int, where: str) -> None:
    """End with an exit code where not all of what was asked for was done. Raises CommandError, after the report."""
    nothing = "" if done else "nothing was done: "
    if failed:
        raise CommandError(f"{nothing}{failed} of {done + failed} records gave no result: {where}.")
    if nothing:
        raise CommandError(f"{nothing}no record was selected.")


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
    found = drawn(results, html)
    ended = f"{found['records']} records, {found['ok']} with a result, {found['participants']} participants"
    say_json(found) if as_json else say(ended, f"written to {html}")


def drawn(results: Path, html: Path) -> dict[str, Any]:
    """Draw a cohort into a file; the keys of `--json`. Raises InputError."""
    need_extra()
    from stimrig.api.cohort.figures import page, repeats
    from stimrig.api.cohort.statistics import read_statistics

    found = read_statistics(results)
    write(html, page(found, results.name))
    of_what, total, counts = found.prevalence()
    return {
        "output": str(html), "records": found.records, "ok": found.ok, "errors": dict(found.errors),
        "participants": len(found.people), "verdicts": dict(found.verdicts), "counted": of_what, "of": total,
        "effects": dict(counts), "repeatability": repeats(found),
    }  # fmt: skip


def need_extra() -> None:
    """Refuse without the extra. Raises InputError: a package is missing."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"needs `pip install stimrig[cohort]` ({', '.join(missing)} is missing)")


MOST_ROWS = 40
"""Changed records that are shown; --json gives all."""
EVERY_S = 60.0
LEAST_S = 5.0
"""Before there is no pace to tell a time from."""


@contextmanager
def telling() -> Iterator[Callable[[Tally], None]]:
    """Give a function that shows a tally on standard error."""
    watched = sys.stderr.isatty() or in_notebook()
    began_s = told_s = time.monotonic()
    with progress_bar() as bar:

        def tell(tally: Tally) -> None:
            nonlocal told_s
            now_s = time.monotonic()
            if watched:
                bar(share(tally), words(tally, now_s - began_s))
            elif now_s - told_s >= EVERY_S:
                told_s = now_s
                print(words(tally, now_s - began_s), file=sys.stderr, flush=True)

        yield tell


def share(tally: Tally) -> float:
    """The share that is done; 0 while it is not known of how much."""
    return min(1.0, tally.handled / tally.total) if tally.total else 0.0


def words(tally: Tally, elapsed_s: float) -> str:
    """A tally in one line."""
    of = "" if tally.total is None else f" of {tally.total}"
    failed = f", {tally.error} failed" if tally.error else ""
    if elapsed_s < LEAST_S or not tally.now:
        return f"{tally.handled}{of}{failed}"
    pace = tally.now / elapsed_s
    left_s = None if tally.total is None else max(0.0, (tally.total - tally.handled) / pace)
    return f"{tally.handled}{of}{failed}, {pace:.3g}/s" + ("" if left_s is None else f", {duration(left_s)} left")


def duration(seconds: float) -> str:
    """A duration in two units at most."""
    minutes = seconds / 60
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes // 60:.0f} h {minutes % 60:.0f} min"


def run_lines(found: dict[str, Any]) -> list[str]:
    """What a person is told of a run."""
    lines = [
        f"records        {found['records']}: {found['ok']} with a result, {found['errors']} without "
        "(column `error` says why)",
        f"this run       {found['computed']} computed, {found['done_before']} done before, {found['took_s']:g} s",
    ]
    lines += passed_over(found, "counted")
    if not found["records"] + found["left_out"]:
        lines.append("Nothing was found. A folder is searched for .h5, .hdf5, .csv, .tsv, .txt and .mat files.")
    return [*lines, f"written to     {found['output']}"]


def passed_over(found: dict[str, Any], done: str) -> list[str]:
    """Records that were not meant, and files whose content was there already."""
    left_out, copies = found["left_out"], found["copies"]
    lines = [f"left out       {left_out} that --select does not mean"] if left_out else []
    return lines + ([f"copies         {copies} files with the content of another: {done} once"] if copies else [])


def changed_lines(found: dict[str, Any]) -> list[str]:
    """A comparison for people."""
    old, new, limits = found["old"], found["new"], found["tolerances"]
    lines = [
        f"{old['verb']}: stimrig {old['software']} ({old['file']}) → stimrig {new['software']} ({new['file']})",
        *([f"made with other options: {found['other_options']}"] if found["other_options"] else []),
        f"{found['compared']} records in both: {found['unchanged']} unchanged, {found['changed']} changed",
        *(f"  {count:6d}  {kind}" for kind, count in found["counts"].items()),
        f"unchanged: a probability within {limits['probability']:g}, a parameter within {limits['parameter_sd']:g} sd "
        f"(without one {100 * limits['parameter_without_sd_relative']:g} %), held-out rms within "
        f"{100 * limits['held_out_rms_relative']:g} %",
    ]
    for words, key in (("old", "only_in_old"), ("new", "only_in_new")):
        if listed := found[key]:
            more = f" and {len(listed) - 10} more" if len(listed) > 10 else ""
            lines.append(f"only in {words}: {len(listed)} ({', '.join(listed[:10])}{more})")
    rows = [
        (row["record"], row["participant"] or "–", row["day"] or "–", "; ".join(row["why"]))
        for row in found["records"][:MOST_ROWS]
    ]
    lines += ["", *table(("record", "participant", "day", "why"), rows)] if rows else []
    hidden = len(found["records"]) - len(rows)
    return [*lines, *([f"and {hidden} records more (--json gives all)"] if hidden else [])]
