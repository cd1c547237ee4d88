"""`stimrig explain`: compare, see where it fails, learn what is missing, add it, watch the error fall."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli.files import load_structure, short, story_of, story_page, write, write_model
from stimrig.api.cli.options import ColumnMap, HeldModel, Json, LastModel, SeveralData
from stimrig.api.cli.terminal import labelled, number, say, say_json
from stimrig.api.progress_bar import progress_bar


def explain(
    data: SeveralData,
    model_json: HeldModel = None,
    html: Annotated[Path | None, typer.Option(help="write the story with its figures here, one file")] = None,
    figures: Annotated[Path | None, typer.Option(help="write each figure as SVG, PDF and PNG into this folder")] = None,
    output: LastModel = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """How far a model goes, step by step: where it fails, what is missing, how the error falls with it, what is left.

    Takes 5 to 40 s, longer where structure is left or with several recordings. Without -o no model is kept.
    """
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        explained = identify.explain(record, progress, model)
    document = story_of(record, explained, structure)
    if output is not None:
        write_model(output, explained.improvement.models[-1])
    if html is not None:
        write(html, story_page(document, short(data)))
    if figures is not None:
        _write_figures(figures, document)
    if as_json:
        say_json({"structure": structure, **explained.to_dict()})
        return
    say(*story_lines(document))
    say(*[f"written to     {path}" for path in (output, html, figures) if path is not None])


def _write_figures(folder: Path, document: dict[str, Any]) -> None:
    from stimrig.api.charts.diagnosis_charts import story_figures
    from stimrig.api.charts.drawing import file

    folder.mkdir(parents=True, exist_ok=True)
    figures = story_figures(document["story"], document["before"], document["after"])
    for name, figure in figures.items():
        for kind in ("svg", "pdf", "png"):
            write(folder / f"{name}.{kind}", file(figure, kind))


def story_lines(document: dict[str, Any]) -> list[str]:
    """Write the story for people at a terminal."""
    story, changed = document["story"], len(document["story"]["rows"]) > 1
    first, last = story["rows"][0], story["rows"][-1]
    lines = [
        f"{story['title']}; the noise is {number(story['noise_sd_nm'], 4)} N·m.",
        "",
        f"1 compare      fit {number(first['fit_percent'])} %, error {number(first['rms_nm'], 4)} N·m; held out fit "
        f"{number(first['held_out_fit_percent'])} %, error {number(first['held_out_rms_nm'], 4)} N·m",
    ]
    lines += labelled("2 fails in", [place["text"] for place in story["places"]] or ["no place stands out"])
    why = story["why"]
    lines += labelled("3 missing", [f"{why['title']}.", *[_named(item) for item in why["missing"]],
                                     *[f"{item['id']}: {item['words']}" for item in why["free"]]])  # fmt: skip
    if changed:
        error = "held-out error" if story["error"] == "held_out_rms_nm" else "error"
        errors = [(number(item["before_nm"], 4), number(item["after_nm"], 4)) for item in story["steps"]]
        added = zip(story["steps"], errors, strict=True)
        lines += labelled("4 added", [f"{item['label']}: {error} {a} -> {b} N·m" for item, (a, b) in added])
        healed = [f"{place['text'].partition(':')[0]}: {place['became']}" for place in story["places"]]
        lines += labelled("  there", healed)
        lines.append(f"  now          fit {number(last['fit_percent'])} %, error {number(last['rms_nm'], 4)} N·m")
    lines += labelled(f"{4 + changed} ended", [story["ended"]])
    experiment = story["then"]["experiment"]
    if experiment:
        lines += labelled("  next", [experiment["text"], "`stimrig test --decide DATA` plays it, judges both."])
    return lines


def _named(item: dict[str, Any]) -> str:
    """Write which effect is missing, how sure that is, and what it is."""
    certainty = f" ({item['sure_words']})" if item["sure_words"] else ""
    return f"{item['id']}{certainty}: {item['plain']}"
