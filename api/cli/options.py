"""Arguments and options that several verbs take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

DATA_HELP = (
    "sealed recording (HDF5); CSV file with the columns time_s,pulse_width_us,torque_nm,segment; or another tool's "
    "table, MAT or Parquet file"
)
Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output, nothing else there")]
Data = Annotated[Path, typer.Argument(help=DATA_HELP, metavar="DATA", show_default=False)]
SeveralData = Annotated[
    list[Path],
    typer.Argument(
        help=f"{DATA_HELP}. Several are joined: recordings of one muscle, each a part of one record",
        metavar="DATA…",
        show_default=False,
    ),
]
ColumnMap = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        help="a column of another tool's file and its unit, such as torque_nm=Drehmoment:Nm; once for each column that "
        "is not called as ours",
        metavar="COLUMN=NAME:UNIT",
        show_default=False,
    ),
]
Html = Annotated[Path | None, typer.Option(help="write a report with charts here")]
LastModel = Annotated[Path | None, typer.Option("-o", "--output", help="write the last MODEL.json")]
ModelFile = Annotated[
    Path, typer.Argument(help="MODEL.json of `stimrig fit -o`", metavar="MODEL.json", show_default=False)
]
HeldModel = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="begin with this model's structure: its effects, their numbers fitted anew to DATA; default: the plain "
        "structure, a recruitment curve f(u) and then second-order dynamics G, without effects",
        metavar="MODEL.json",
        show_default=False,
    ),
]
RigFile = Annotated[Path | None, typer.Option(help="rig file (TOML); default: the emulated rig")]
DataDir = Annotated[Path | None, typer.Option(help="data folder; default ./var, or STIMRIG_DATA_DIR")]
RigData = Annotated[Path | None, typer.Option(help="the rig's data folder, where it has one of its own")]
Emulate = Annotated[str, typer.Option(help='options for the emulator, e.g. "--patient changing"')]


def set_options(**options: Any) -> dict[str, Any]:
    """Return the options that are set; the environment supplies the others."""
    return {name: value for name, value in options.items() if value is not None}


def names(text: str | None) -> tuple[str, ...]:
    """Split a comma-separated list."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())
