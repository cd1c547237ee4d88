"""`stimrig invert`: the pulse widths with which a model follows a reference torque."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import load_model, write
from stimrig.api.cli.options import Json, ModelFile
from stimrig.api.cli.terminal import number, percent, say, say_json, table


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
    from stimrig.api.models import inverted
    from stimrig.identify.errors import IdentifyError
    from stimrig.identify.inversion import invert as widths_for
    from stimrig.identify.inversion.reference import read_reference

    model = load_model(model_json, "invert MODEL.json REFERENCE.csv -o FILE")
    try:
        content = reference.read_bytes()
    except OSError as error:
        raise InputError(f"{reference}: {error.strerror}. Give a CSV file with time_s,torque_nm.") from error
    try:
        wanted = read_reference(content, str(reference), model.pulse_rate_hz)
        inversion = widths_for(model, wanted, largest_us=largest_us, rise_us=rise_us, shortest_us=shortest_us).to_dict()
    except IdentifyError as error:
        raise InputError(str(error)) from error
    write(output, inverted.table(inversion))
    if as_json:
        say_json({"output": str(output), **inversion})
        return
    fit = percent(inversion["fit_percent"])
    say(f"{output}: {len(inversion['pulse_width_us'])} pulses, fit {fit} where it can be reached")
    if inversion["unreachable"]:
        rows = [
            [f"{row['begin_s']:.2f}", f"{row['end_s']:.2f}", number(row["shortfall_nm"], 3), row["reason"]]
            for row in inversion["unreachable"]
        ]
        say(*table(["begin (s)", "end (s)", "lacks (N·m)", "reason"], rows))
