"""`stimrig predict`: a model's free run beside the measurement, as CSV or MAT file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig import identify
from stimrig.api.cli.files import load_model, load_record, writing
from stimrig.api.cli.options import ColumnMap, Data, Json, ModelFile
from stimrig.api.cli.terminal import number, percent, say, say_json


def predict(
    model_json: ModelFile,
    data: Data,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV or .mat file to write", show_default=False)],
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Free-run simulation from the recorded pulse widths: time_s,torque_nm,predicted_torque_nm."""
    import numpy as np

    from stimrig.identify import plain_mat
    from stimrig.identify.estimation.fit_statistics import best_fit_percent

    model = load_model(model_json, "predict MODEL.json DATA -o FILE")
    record = load_record([data], columns)
    predicted = np.asarray(identify.predict(model, record))
    rows = {"time_s": record.time_s, "torque_nm": record.torque_nm, "predicted_torque_nm": predicted}
    with writing(output) as place:
        if output.suffix.lower() == ".mat":
            plain_mat.write(place, rows)
        else:
            np.savetxt(place, np.column_stack(list(rows.values())), "%.9g", ",", header=",".join(rows), comments="")
    reached = best_fit_percent(record.torque_nm, predicted)
    rms_nm = float(np.sqrt(np.mean((record.torque_nm - predicted) ** 2)))
    if as_json:
        say_json({"output": str(output), "rows": len(predicted), "fit_percent": reached, "rms_nm": rms_nm})
        return
    say(f"{output}: {len(predicted)} rows, fit {percent(reached)} over the whole record, rms {number(rms_nm, 4)} N·m")
