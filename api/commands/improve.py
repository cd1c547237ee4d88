"""`stimrig improve`: effects added one by one while the evidence lasts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from api.terminal import Data, Json, number, progress_line, say, say_json, table, write


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("improve")(improve)


def improve(
    data: Data,
    html: Annotated[Path | None, typer.Option(help="write a report with charts here")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="write the last MODEL.json here")] = None,
    as_json: Json = False,
) -> None:
    """Add effects one by one to the plain structure while the evidence lasts; each step is a model."""
    import identify

    record = identify.read(data)
    progress = progress_line()
    improved = identify.improve(record, progress=progress)
    progress(1.0, "done")
    found, models = improved.to_dict(), improved.models
    del found["models"]
    if output is not None:
        write(output, json.dumps(models[-1].to_dict(), indent=1))
    if html is not None:
        write(html, report(record, found, models, data))
    if as_json:
        say_json(found)
        return
    say(*improvement_lines(found))
    say(*[f"written to {path}" for path in (output, html) if path is not None])


def report(record: Any, found: dict[str, Any], models: Sequence[Any], data: Path) -> str:
    """The report: what was found, what each effect is, what is left before and after."""
    import numpy as np

    import identify
    from api.jobs import runs, thinned
    from api.missing import diagnosis
    from api.report import improvement_html

    before, after = (thinned(identify.compare(model, record).to_dict()) for model in (models[0], models[-1]))
    labels = [str(record.segment_names[index]) for index in record.segment]
    segments = runs(labels, np.asarray(record.time_s))
    return improvement_html(found, data.name, diagnosis(str(data), progress_line()), before, after, segments)


def improvement_lines(found: dict[str, Any]) -> list[str]:
    """The steps for people."""
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
    return [*table(header, rows), "", f"noise {number(found['noise_sd_nm'], 4)} N·m; verdict: {found['verdict']}"]
