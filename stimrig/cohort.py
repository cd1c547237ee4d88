"""`stimrig cohort`: one verb over many recordings, two runs compared, figures (docs/cohorts.md).

`options` are those of the command line: `select`, `method`, `effects`, `scheduler`, `workers`, `memory`, `limit`, …
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig.verbs import Report

__all__ = ["changed", "diagnose", "figures", "fit", "improve"]


def _run(verb: str, data: Sequence[str | Path], output: str | Path, options: dict[str, Any]) -> Report:
    from stimrig.api.cli.commands.cohort import require_extra
    from stimrig.api.cli.options import names

    require_extra()
    from stimrig.api.cohort.run import run_cohort

    options["effects"] = names(options.get("effects"))
    return Report(f"cohort {verb}", run_cohort(verb, [str(place) for place in data], Path(output), **options))


def fit(data: Sequence[str | Path], output: str | Path, **options: Any) -> Report:
    """Fit a model to every selected record; one row each in Parquet.

    Parameters
    ----------
    data : sequence of path
        Files, folders, buckets.
    output : path
        Parquet file to write; one that was cut off goes on.
    **options
        Those of the command line.
    """
    return _run("fit", data, output, options)


def diagnose(data: Sequence[str | Path], output: str | Path, **options: Any) -> Report:
    """What is missing in the plain structure, for every selected record; one row each in Parquet.

    Parameters
    ----------
    data : sequence of path
        Files, folders, buckets.
    output : path
        Parquet file to write; one that was cut off goes on.
    **options
        Those of the command line.
    """
    return _run("diagnose", data, output, options)


def improve(data: Sequence[str | Path], output: str | Path, **options: Any) -> Report:
    """Add effects as long as the evidence lasts, for every selected record; one row each in Parquet.

    Parameters
    ----------
    data : sequence of path
        Files, folders, buckets.
    output : path
        Parquet file to write; one that was cut off goes on.
    **options
        Those of the command line.
    """
    return _run("improve", data, output, options)


def changed(old: str | Path, new: str | Path) -> Report:
    """Whose results differ between two runs, and why.

    Parameters
    ----------
    old : path
        Results of the earlier run.
    new : path
        Results of the later one.
    """
    from stimrig.api.cli.commands.cohort import require_extra

    require_extra()
    from stimrig.api.cohort.changed import compare_runs

    return Report("cohort changed", compare_runs(Path(old), Path(new)))


def figures(results: str | Path, html: str | Path) -> Report:
    """Draw a cohort into an HTML file: effects by prevalence, parameters over sessions, errors by reason.

    Parameters
    ----------
    results : path
        The Parquet file of a run.
    html : path
        File to write.
    """
    from stimrig.api.cli.commands.cohort import draw

    return Report("cohort figures", draw(Path(results), Path(html)))
