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
    shown = story_of(record, explained, structure)
    if output is not None:
        write_model(output, explained.improvement.models[-1])
    if html is not None:
        write(html, story_page(shown, short(data)))
    if figures is not None:
        _write_figures(figures, shown)
    if as_json:
        say_json({"structure": structure, **explained.to_dict()})
        return
    say(*story_lines(shown))
    say(*[f"written to     {path}" for path in (output, html, figures) if path is not None])


def _write_figures(folder: Path, shown: dict[str, Any]) -> None:
    from stimrig.api.charts.story_charts import story_figures

    folder.mkdir(parents=True, exist_ok=True)
    figures = story_figures(shown["story"], shown["before"], shown["after"])
    for name in figures:
        for kind in ("svg", "pdf", "png"):
            write(folder / f"{name}.{kind}", figures.file(name, kind))


def story_lines(shown: dict[str, Any]) -> list[str]:
    """Write the story for people at a terminal."""
    made, changed = shown["story"], len(shown["story"]["rows"]) > 1
    first, last = made["rows"][0], made["rows"][-1]
    lines = [
        f"{made['title']}; the noise is {number(made['noise_sd_nm'], 4)} N·m.",
        "",
        f"1 compare      fit {number(first['fit_percent'])} %, error {number(first['rms_nm'], 4)} N·m; held out fit "
        f"{number(first['held_out_fit_percent'])} %, error {number(first['held_out_rms_nm'], 4)} N·m",
    ]
    lines += labelled("2 fails in", [place["text"] for place in made["places"]] or ["no place stands out"])
    why = made["why"]
    lines += labelled("3 missing", [f"{why['title']}.", *[_named(one) for one in why["missing"]],
                                     *[f"{one['id']}: {one['words']}" for one in why["free"]]])  # fmt: skip
    if changed:
        error = "held-out error" if made["error"] == "held_out_rms_nm" else "error"
        errors = [(number(one["before_nm"], 4), number(one["after_nm"], 4)) for one in made["steps"]]
        added = zip(made["steps"], errors, strict=True)
        lines += labelled("4 added", [f"{one['label']}: {error} {a} -> {b} N·m" for one, (a, b) in added])
        healed = [f"{place['text'].partition(':')[0]}: {place['became']}" for place in made["places"]]
        lines += labelled("  there", healed)
        lines.append(f"  now          fit {number(last['fit_percent'])} %, error {number(last['rms_nm'], 4)} N·m")
    lines += labelled(f"{4 + changed} ended", [made["ended"]])
    experiment = made["then"]["experiment"]
    if experiment:
        lines += labelled("  next", [experiment["text"], "`stimrig test --decide DATA` plays it, judges both."])
    return lines


def _named(one: dict[str, Any]) -> str:
    """Write which effect is missing, how sure that is, and what it is."""
    sure = f" ({one['sure_words']})" if one["sure_words"] else ""
    return f"{one['id']}{sure}: {one['plain']}"
