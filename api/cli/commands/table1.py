"""`stimrig table1`: the paper's Table I, ours beside theirs."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import number, say, say_json, table
from stimrig.api.progress_bar import progress_bar


def table1(
    trials: Annotated[int, typer.Option(min=1, max=10000, help="records for each noise level")] = 100,
    as_json: Json = False,
) -> None:
    """Best-fit rates at each noise level, ours beside the paper's."""
    from stimrig.identify import paper

    with progress_bar() as progress:
        result = paper.table1(trials, progress)
    say_json(result) if as_json else say(*lines(result))


def lines(result: dict[str, Any]) -> list[str]:
    """The table for people."""
    rows = result["rows"]
    header = list(rows[0])
    body = [[str(row[key]) if isinstance(row[key], str) else number(row[key]) for key in header] for row in rows]
    rest = [f"{key}: {value}" for key, value in result.items() if key != "rows"]
    return [*table(header, body), "", *rest]
