"""`stimrig predict`: a model's free run beside the measurement, as CSV or MAT file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stimrig import identify
from stimrig.api.cli.files import check_outputs, load_model, load_record
from stimrig.api.cli.options import ColumnMap, Data, Json, ModelFile
from stimrig.api.cli.terminal import report
from stimrig.api.whole_file import whole_path


def predict(
    model_json: ModelFile,
    data: Data,
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file to write", show_default=False)],
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Free-run simulation from the recorded pulse widths: time_s,torque_nm,predicted_torque_nm."""
    import numpy as np

    from stimrig.identify.estimation.fit_statistics import best_fit_percent
    from stimrig.identify.summary import fit_words

    check_outputs([model_json, data], output)
    model = load_model(model_json)
    record = load_record([data], columns)
    predicted = np.asarray(identify.predict(model, record))
    rows = {"time_s": record.time_s, "torque_nm": record.torque_nm, "predicted_torque_nm": predicted}
    with whole_path(output) as place, place.open("w") as file:  # numpy would open a pipe twice
        np.savetxt(file, np.column_stack(list(rows.values())), "%.9g", ",", header=",".join(rows), comments="")
    figures = {
        "fit_percent": best_fit_percent(record.torque_nm, predicted),
        "rms_nm": float(np.sqrt(np.mean((record.torque_nm - predicted) ** 2))),
    }
    words = f"{len(predicted)} rows, {fit_words(figures)} over the whole record"
    report({"output": str(output), "rows": len(predicted), **figures}, as_json, words, files=[output])
