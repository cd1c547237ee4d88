"""What `stimrig cohort` tells people: how far a run is (a bar, or a line a minute in a log), its end, two compared."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from stimrig.api.cli.terminal import table
from stimrig.api.progress_bar import in_notebook, progress_bar

if TYPE_CHECKING:
    from stimrig.api.cohort.run import Tally

MOST_ROWS = 40
"""Changed records that are shown; --json gives all."""
EVERY_S = 60.0
LEAST_S = 5.0
"""Before there is no pace to tell a time from."""


@contextmanager
def telling(dashboard: str = "") -> Iterator[Callable[[Tally], None]]:
    """A function that shows a tally on standard error.

    Parameters
    ----------
    dashboard : str
        Address of Dask's dashboard, said first; empty: none.
    """
    if dashboard:
        print(f"dashboard      {dashboard}", file=sys.stderr, flush=True)
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
    if found["left_out"]:
        lines.append(f"left out       {found['left_out']} that --select does not mean")
    if found["copies"]:
        lines.append(f"copies         {found['copies']} files with the content of another: counted once")
    if not found["records"] + found["left_out"]:
        lines.append("Nothing was found. A folder is searched for .h5, .hdf5, .csv, .tsv, .txt and .mat files.")
    return [*lines, f"written to     {found['output']}"]


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
