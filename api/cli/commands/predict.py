"""`stimrig predict`: a model's free run beside the measurement, as CSV."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from api.cli.errors import InputError
from api.cli.terminal import Data, Json, ModelFile, load_model, number, percent, say, say_json


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("predict")(predict)


def predict(
    model_json: ModelFile,
    data: Data,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file to write", show_default=False)],
    as_json: Json = False,
) -> None:
    """Free-run simulation from the recorded pulse widths: time_s,torque_nm,predicted_torque_nm."""
    import numpy as np

    import identify
    from identify.estimation.figures import best_fit_percent

    model = load_model(model_json)
    record = identify.read(data)
    predicted = np.asarray(identify.predict(model, record))
    columns = np.column_stack([record.time_s, record.torque_nm, predicted])
    try:
        np.savetxt(output, columns, "%.9g", ",", header="time_s,torque_nm,predicted_torque_nm", comments="")
    except OSError as error:
        raise InputError(f"{output}: {error.strerror}. Give a file in a folder that can be written.") from error
    residual = record.torque_nm - predicted
    reached = best_fit_percent(record.torque_nm, predicted)
    rms_nm = float(np.sqrt(np.mean(residual**2)))
    if as_json:
        say_json({"output": str(output), "rows": len(predicted), "fit_percent": reached, "rms_nm": rms_nm})
        return
    say(f"{output}: {len(predicted)} rows, fit {percent(reached)} over the whole record, rms {number(rms_nm, 4)} N·m")
