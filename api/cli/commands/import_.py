"""`stimrig import`: another tool's recording as a CSV file that every verb reads; what is not known is asked for."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.terminal import ColumnMap, Json, say, say_json, writing
from stimrig.api.version import software_version
from stimrig.identify.errors import BadRequest

File = Annotated[Path, typer.Argument(help="NWB, BIDS, XDF, Parquet or FHIR file", metavar="FILE", show_default=False)]
Output = Annotated[Path, typer.Option("-o", "--output", help="CSV file to write", show_default=False)]
Segments = Annotated[str, typer.Option(help="what names the segments in it, or none", show_default=False)]
Sign = Annotated[
    str, typer.Option(help="+1 or -1: the sign that the stimulated muscle's torque has", show_default=False)
]


def import_(
    file: File,
    output: Output,
    columns: ColumnMap = None,
    segments: Segments = "",
    sign: Sign = "",
    lever_arm_m: Annotated[float | None, typer.Option(help="of a force", show_default=False)] = None,
    pulse_width_us: Annotated[float | None, typer.Option(help="of marks without widths", show_default=False)] = None,
    pulse_rate_hz: Annotated[float | None, typer.Option(help="pulses a second", show_default=False)] = None,
    clock_offset_s: Annotated[float | None, typer.Option(help="added to the pulses' times", show_default=False)] = None,
    as_json: Json = False,
) -> None:
    """Take in another tool's recording (NWB, BIDS, XDF, Parquet, FHIR) as CSV; tells what it took."""
    from stimrig.identify.records.columns import parsed
    from stimrig.identify.records.join import write_joined

    mapped = {target: asked.text for target, asked in parsed(columns).items()}
    numbers = {"sign": sign or None, "lever_arm_m": lever_arm_m, "pulse_width_us": pulse_width_us,
               "pulse_rate_hz": pulse_rate_hz, "clock_offset_s": clock_offset_s}  # fmt: skip
    somebody = sys.stdin.isatty() and not as_json
    record, found = taken(file, answers(mapped, segments, numbers), somebody)
    with writing(output) as place:
        write_joined(record, place, f"stimrig import: {json.dumps(found, ensure_ascii=True)}")
    found = {"output": str(output), "rows": int(record.time_s.size), **found}
    say_json(found) if as_json else say(*report(found))


NOT_MAPPED = {
    "time_s": "Each format says its times; in a Parquet file name the column time_s, or give its unit in its metadata.",
    "segment": "Give --segments.",
}
"""Columns of tables that are no signals of other tools' files."""


def answers(columns: Mapping[str, str] | None, segments: str, numbers: Mapping[str, Any]) -> dict[str, str]:
    """What was given, by option."""
    found = {name.replace("_", "-"): str(value) for name, value in numbers.items() if value is not None}
    return {**found, **({"segments": segments} if segments else {}), **(columns or {})}


def taken(path: Path, given: Mapping[str, str], somebody: bool = False) -> tuple[Any, dict[str, Any]]:
    """The record, and what was taken of the file; `somebody`: whether a person is there to ask."""
    from stimrig.api.exchange.inward import read_foreign
    from stimrig.api.exchange.inward.taking import Taking

    for target, fix in NOT_MAPPED.items():
        if target in given:
            raise BadRequest("an import does not take it", place=f"--map {target}", fix=fix)
    foreign = read_foreign(path)
    taking = Taking(path, foreign, given, _asked if somebody else _refused)
    record = taking.record()
    return record, {
        "file": path.name, "format": foreign.format, "sha256": record.source.sha256, "taken": taking.taken,
        "answered_by": "our own export" if foreign.own else "options and answers", "about": dict(foreign.about),
        "notes": list(record.notes), "software": f"stimrig {software_version()}",
    }  # fmt: skip


def _asked(option: str, question: str, choices: Sequence[str]) -> str:
    """Ask a person at the terminal."""
    say_to_person = [question, *(f"  {choice}" for choice in choices)]
    typer.echo("\n".join(say_to_person), err=True)
    return str(typer.prompt(option, err=True, prompt_suffix=" "))


def _refused(option: str, question: str, choices: Sequence[str]) -> str:
    """Nobody is there: one line with the option to give, and the choices."""
    listed = (
        f"; there are: {', '.join(choices[:MOST_SHOWN])}{', …' if len(choices) > MOST_SHOWN else ''}" if choices else ""
    )
    raise BadRequest(question.rstrip("?"), place="not known", fix=f"Give {option}{listed}.")


MOST_SHOWN = 12


def report(found: Mapping[str, Any]) -> list[str]:
    """What a person is told of an import."""
    lines = []
    for name, what in found["taken"].items():
        told = what if isinstance(what, str) else json.dumps(what, ensure_ascii=False).strip("{}").replace('"', "")
        lines.append(f"{name:<15}{told}")
    lines += [f"{'note':<15}{note}" for note in found["notes"]]
    return [*lines, f"{'written to':<15}{found['output']}: {found['rows']} rows, taken from {found['format']}"]
