"""`stimrig compare`: measurement against model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from api.terminal import Data, Json, ModelFile, load_model, model_report, say, say_json, write


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("compare")(compare)


def compare(
    model_json: ModelFile,
    data: Data,
    html: Annotated[Path | None, typer.Option(help="write a report with charts here")] = None,
    as_json: Json = False,
) -> None:
    """Measurement against the model's free run: where it fails, and by how much."""
    import identify
    from api.jobs import clean, curves
    from api.report import comparison_html

    model = load_model(model_json)
    record = identify.read(data)
    found = clean(dict(identify.compare(model, record)))
    if html is not None:
        write(html, comparison_html(model.to_dict(), clean(curves(model, record)), data.name))
    if as_json:
        say_json(found)
        return
    say(f"{data} against {model_json}", "", *model_report(model.to_dict()), "", *comparison_lines(found))
    if html is not None:
        say("", f"report         {html}")


def comparison_lines(found: dict[str, Any]) -> list[str]:
    """The comparison in words; what is a number or a sentence, and the worst places."""
    lines = []
    for key, value in found.items():
        if isinstance(value, int | float | str) and not isinstance(value, bool):
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            lines.append(f"{key:28} {shown}")
    for place in found.get("where") or found.get("worst") or []:
        words = place.get("words") if isinstance(place, dict) else None
        if words:
            lines.append(f"  {words}")
    return lines
