"""`stimrig cohort`: one verb over many recordings (docs/cohorts.md).

`options` are those of the command line: `select`, `method`, `effects`, `scheduler`, `workers`, `memory`, `limit`, …
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig.verbs import Report

__all__ = ["diagnose", "fit", "improve"]


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
