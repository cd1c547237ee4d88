"""`stimrig invert`: the pulse widths with which a model follows a reference torque."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.files import check_outputs, inversion_table, load_model, write
from stimrig.api.cli.options import Json, ModelFile
from stimrig.api.cli.terminal import report


def invert(
    model_json: ModelFile,
    reference: Annotated[
        Path, typer.Argument(help="CSV file: time_s,torque_nm, or torque_nm alone", metavar="REFERENCE.csv")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file to write", show_default=False)],
    largest_us: Annotated[
        float | None, typer.Option(help="widest pulse, µs; default: what the model holds for")
    ] = None,
    rise_us: Annotated[float | None, typer.Option(help="largest rise from pulse to pulse, µs")] = 50.0,
    shortest_us: Annotated[
        float, typer.Option(help="shortest pulse of the stimulator, µs; a narrower one is not sent")
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Pulse widths whose predicted torque follows a reference best, and what of it is out of reach."""
    from stimrig.identify.inversion import invert as widths_for
    from stimrig.identify.inversion.reference import read_reference

    check_outputs([model_json, reference], output)
    model = load_model(model_json)
    wanted = read_reference(reference.read_bytes(), str(reference), model.pulse_rate_hz)
    inversion = widths_for(model, wanted, largest_us=largest_us, rise_us=rise_us, shortest_us=shortest_us)
    write(output, inversion_table(inversion.to_dict()))
    report({"output": str(output), **inversion.to_dict()}, as_json, inversion, files=[output])
