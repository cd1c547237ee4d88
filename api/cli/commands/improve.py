"""`stimrig improve`: effects added one by one as long as the evidence supports it."""

from __future__ import annotations

from stimrig import identify
from stimrig.api.cli.files import check_outputs, html_report, load_structure, short, write
from stimrig.api.cli.options import ColumnMap, HeldModel, Html, Json, LastModel, SeveralData
from stimrig.api.cli.terminal import report
from stimrig.api.progress_bar import progress_bar


def improve(
    data: SeveralData,
    model_json: HeldModel = None,
    html: Html = None,
    output: LastModel = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Add effects one by one to a model's structure as long as the evidence supports it; each step is a model.

    Takes 5 to 60 s; up to three minutes where structure is left, with several recordings, or on a busy computer.

    Without -o nothing is kept.
    """
    check_outputs([*data, model_json], output, html)
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        if html is None:
            improved = identify.improve(record, progress=progress, model=model)
        else:
            explained = identify.explain(record, progress, model)
            improved = explained.improvement
            write(html, html_report(explained, record, short(data)))
    write(output, improved.models[-1])
    document = {"structure": structure, **improved.to_dict()}
    del document["models"]
    report(document, as_json, improved, files=[output, html])
