"""`stimrig compare`: measurement against model."""

from __future__ import annotations

from stimrig import identify
from stimrig.api.cli.files import check_outputs, html_report, load_model, load_record, short, write
from stimrig.api.cli.options import ColumnMap, Html, Json, ModelFile, SeveralData
from stimrig.api.cli.terminal import report


def compare(
    model_json: ModelFile, data: SeveralData, html: Html = None, columns: ColumnMap = None, as_json: Json = False
) -> None:
    """Measurement against model: where it fails, and by how much.

    The model runs free: it is given the pulse widths alone, never the measured torque.
    """
    check_outputs([model_json, *data], html)
    model = load_model(model_json)
    record = load_record(data, columns)
    compared = identify.compare(model, record)
    if html is not None:
        write(html, html_report(model, record, short(data)))
    report(compared.to_dict(), as_json, model, "", f"{short(data)} against it", compared, files=[html])
