"""`stimrig improve`: effects added one by one as long as the evidence supports it."""

from __future__ import annotations

from typing import Any

from stimrig import identify
from stimrig.api.cli.files import load_structure, short, story_of, story_page, write, write_model
from stimrig.api.cli.options import ColumnMap, HeldModel, Html, Json, LastModel, SeveralData
from stimrig.api.cli.reports import repetition_lines
from stimrig.api.cli.terminal import labelled, number, say, say_json, table
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words

FEW = 3
"""Refused effects that are named."""


def improve(
    data: SeveralData,
    model_json: HeldModel = None,
    html: Html = None,
    output: LastModel = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Add effects one by one to a model's structure as long as the evidence supports it; each step is a model.

    Takes 5 to 40 s, longer where structure is left or with several recordings. Without -o nothing is kept.
    """
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        if html is None:
            improved = identify.improve(record, progress=progress, model=model)
        else:
            explained = identify.explain(record, progress, model)
            improved = explained.improvement
            write(html, story_page(story_of(record, explained, structure), short(data)))
    document = {"structure": structure, **improved.to_dict()}
    del document["models"]
    if output is not None:
        write_model(output, improved.models[-1])
    if as_json:
        say_json(document)
    else:
        say(*improvement_lines(document), *[f"written to     {path}" for path in (output, html) if path is not None])


def improvement_lines(document: dict[str, Any]) -> list[str]:
    """Write the steps for people."""
    from stimrig.identify.effects import any_free

    rows = [
        (
            step["added"] or "base model",
            number(step.get("fit_percent")),
            number(step.get("rms_nm"), 4),
            number(step.get("held_out_fit_percent")),
            number(step.get("held_out_rms_nm"), 4),
        )
        for step in document["steps"]
    ]
    header = ("added", "fit %", "error N·m", "held-out fit %", "held-out error N·m")
    lines = [f"structure      {in_words(document['structure'])}", "", *table(header, rows), ""]
    lines.append(f"noise          {number(document['noise_sd_nm'], 4)} N·m: of a sample, which no model can explain")
    lines += repetition_lines(document["steps"][-1])
    added = [step for step in document["steps"] if step["added"]]
    lines += [f"{step['added']:15}{step['reason']}" for step in added if any_free([step["added"]])]
    refused = [f"{row['effect']}: {row['reason']}" for row in document.get("refused") or []]
    if len(refused) > FEW:
        refused[FEW:] = [f"and {len(refused) - FEW} effects more (--json says which)"]
    return [*lines, *labelled("not added", refused)]
