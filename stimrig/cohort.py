"""`stimrig cohort`: one verb over many recordings (docs/cohorts.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stimrig.verbs import Report

__all__ = ["diagnose", "fit", "improve"]

PARAMETERS = """

    Parameters
    ----------
    data : sequence of path
        Files, folders, buckets.
    output : path
        Parquet file to write; one that was cut off goes on.
    **options
        Those of the command line: `select`, `method`, `effects`, `scheduler`, `workers`, `memory`, `limit`, …
"""


def _over_records(verb: str, words: str) -> Callable[..., Report]:
    def run(data: Sequence[str | Path], output: str | Path, **options: Any) -> Report:
        from stimrig.api.cli.commands.cohort import require_extra
        from stimrig.api.cli.options import names

        require_extra()
        from stimrig.api.cohort.run import run_cohort

        options["effects"] = names(options.get("effects"))
        return Report(f"cohort {verb}", run_cohort(verb, [str(place) for place in data], Path(output), **options))

    run.__name__ = run.__qualname__ = verb
    run.__doc__ = f"{words}, for every selected record; one row each in Parquet.{PARAMETERS}"
    return run


fit = _over_records("fit", "Fit a model")
diagnose = _over_records("diagnose", "What is missing in the plain structure")
improve = _over_records("improve", "Add effects as long as the evidence lasts")
