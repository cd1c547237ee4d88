"""`stimrig compare`: measurement against model."""

from __future__ import annotations

from typing import Any

from stimrig import identify
from stimrig.api.cli.result_files import report
from stimrig.api.cli.terminal import (
    ColumnMap,
    Html,
    Json,
    ModelFile,
    SeveralData,
    called,
    load_model,
    load_record,
    model_report,
    say,
    say_json,
    short,
    write,
)
from stimrig.identify.healing import looks_like_noise


def compare(
    model_json: ModelFile,
    data: SeveralData,
    html: Html = None,
    columns: ColumnMap = None,
    as_json: Json = False,
) -> None:
    """Measurement against model: where it fails, and by how much.

    The model runs free: it is given the pulse widths alone, never the measured torque.
    """
    model = load_model(model_json, "compare MODEL.json DATA")
    record = load_record(data, columns)
    compared = identify.compare(model, record)
    found = compared.to_dict()
    if html is not None:
        write(html, report(model, record, short(data), compared))
    if as_json:
        say_json(found)
        return
    about = f"{model_json}, its figures on what it was fitted to"
    say(about, *model_report(model.to_dict()), "", f"{called(data)} against it, all rows", *comparison_lines(found))
    if html is not None:
        say("", f"report         {html}")


def comparison_lines(found: dict[str, Any]) -> list[str]:
    """The comparison in words, the worst places, and where the error above the noise sits."""
    places = [place["text"] for place in found["where"]]
    named_below = {f"{text}." for text in places}
    lines = [line for line in found["plain"] if line not in named_below]
    if looks_like_noise(found):
        return [*lines, "No place stands out."]
    if places:
        lines += ["", "worst places", *[f"  {text}" for text in places]]
    for kind in ("segment", "level", "direction", "frequency"):
        rows = (found.get("by") or {}).get(kind) or []
        shares = [
            f"{row['label']} {100 * row['share_of_excess']:.0f} %" for row in rows if row["share_of_excess"] > 0.005
        ]
        if shares:
            lines.append(f"by {kind:12}{', '.join(shares)}")
    if any(line.startswith("by ") for line in lines):
        lines.append("               in % of the error above the noise")
    return lines
