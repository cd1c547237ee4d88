"""`stimrig improve`: effects added one by one as long as the evidence supports it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli.commands.diagnose import VERDICTS
from stimrig.api.cli.terminal import (
    ColumnMap,
    HeldModel,
    Json,
    SeveralData,
    load_held,
    number,
    repetition_lines,
    say,
    say_json,
    short,
    table,
    write,
    write_model,
)
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words

FEW = 3
"""Refused effects that are named."""


def improve(
    data: SeveralData,
    model_json: HeldModel = None,
    html: Annotated[Path | None, typer.Option(help="write a report with charts here")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="write the last MODEL.json, or MODEL.mat")
    ] = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Add effects one by one to a model's structure as long as the evidence supports it; each step is a model.

    Takes 5 to 40 s, longer where structure is left or with several recordings. Without -o nothing is kept.
    """
    record, model, structure = load_held(model_json, data, columns)
    with progress_bar() as progress:
        improved = identify.improve(record, progress=progress, model=model)
    found, models = {"structure": structure, **improved.to_dict()}, improved.models
    del found["models"]
    if output is not None:
        write_model(output, models[-1])
    if html is not None:
        write(html, report(record, found, models, short(data), model))
    if as_json:
        say_json(found)
        return
    say(*improvement_lines(found))
    say(*[f"written to     {path}" for path in (output, html) if path is not None])


def report(record: Any, found: dict[str, Any], models: Sequence[Any], name: str, held: Any | None = None) -> str:
    """The report: what was found, what each effect is, what is left before and after."""
    import numpy as np

    from stimrig.api.web.pages.report_file import improvement_html
    from stimrig.api.workers.curves import runs, thinned
    from stimrig.api.workers.verbs import diagnosed

    before, after = (thinned(identify.compare(model, record).to_dict()) for model in (models[0], models[-1]))
    labels = [str(record.segment_names[index]) for index in record.segment]
    segments = runs(labels, np.asarray(record.time_s))
    with progress_bar() as progress:
        missing = diagnosed(record, progress, None if held is None else held.to_json())
    return improvement_html(found, name, missing, before, after, segments)


def improvement_lines(found: dict[str, Any]) -> list[str]:
    """The steps for people."""
    from stimrig.identify.effects import any_free

    rows = [
        (
            step["added"] or "base model",
            number(step.get("fit_percent")),
            number(step.get("rms_nm"), 4),
            number(step.get("held_out_fit_percent")),
            number(step.get("held_out_rms_nm"), 4),
        )
        for step in found["steps"]
    ]
    header = ("added", "fit %", "rms N·m", "held-out %", "held-out rms N·m")
    lines = [f"structure      {in_words(found['structure'])}", "", *table(header, rows), ""]
    lines.append(f"noise          {number(found['noise_sd_nm'], 4)} N·m: of a sample, which no model can explain")
    lines += repetition_lines(found["steps"][-1])
    added = [step for step in found["steps"] if step["added"]]
    lines += [f"{step['added']:15}{step['reason']}" for step in added if any_free([step["added"]])]
    lines.append(f"at first       {VERDICTS.get(found['verdict'], found['verdict'])}")
    refused = [f"{row['effect']}: {row['reason']}" for row in found.get("refused") or []]
    if len(refused) > FEW:
        refused[FEW:] = [f"and {len(refused) - FEW} effects more (--json says which)"]
    return [*lines, *[f"{'not added' if not number else '':15}{text}" for number, text in enumerate(refused)]]
