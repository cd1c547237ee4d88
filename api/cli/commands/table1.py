"""`stimrig table1`: the paper's Table I, ours beside theirs."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import report
from stimrig.api.progress_bar import progress_bar


def table1(
    trials: Annotated[int, typer.Option(min=1, max=10000, help="records for each noise level")] = 100,
    as_json: Json = False,
) -> None:
    """Best-fit rates at each noise level, ours beside the paper's."""
    from stimrig.identify import paper

    with progress_bar() as progress:
        result = paper.table1(trials, progress)
    further = [f"{key}: {value}" for key, value in result.items() if key != "rows"]
    report(result, as_json, *lines(result["rows"]), "", *further)


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """Write the rows below their names, aligned."""
    cells = [list(rows[0]), *([f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]
