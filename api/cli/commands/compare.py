"""`stimrig compare`: measurement against model."""

from __future__ import annotations

from typing import Any

from stimrig import identify
from stimrig.api.cli.files import load_model, load_record, report, short, write
from stimrig.api.cli.options import ColumnMap, Html, Json, ModelFile, SeveralData
from stimrig.api.cli.reports import model_report
from stimrig.api.cli.terminal import say, say_json
from stimrig.identify.healing import looks_like_noise


def compare(
    model_json: ModelFile, data: SeveralData, html: Html = None, columns: ColumnMap = None, as_json: Json = False
) -> None:
    """Measurement against model: where it fails, and by how much.

    The model runs free: it is given the pulse widths alone, never the measured torque.
    """
    model = load_model(model_json, "compare MODEL.json DATA")
    record = load_record(data, columns)
    compared = identify.compare(model, record)
    if html is not None:
        write(html, report(model, record, short(data), compared))
    if as_json:
        say_json(compared.to_dict())
        return
    files = " and ".join(map(str, data)) if len(data) < 3 else f"{len(data)} recordings, {data[0]} first"
    say(f"{model_json}, its figures on what it was fitted to", *model_report(model.to_dict()))
    say("", f"{files} against it, all rows", *comparison_lines(compared.to_dict()))
    if html is not None:
        say("", f"report         {html}")


def comparison_lines(comparison: dict[str, Any]) -> list[str]:
    """Write the comparison in words, the worst places, and where the error above the noise sits."""
    places = [place["text"] for place in comparison["where"]]
    lines = [line for line in comparison["plain"] if line not in {f"{text}." for text in places}]
    if looks_like_noise(comparison):
        return [*lines, "No place stands out."]
    if places:
        lines += ["", "worst places", *[f"  {text}" for text in places]]
    split = []
    for kind in ("segment", "level", "direction", "frequency"):
        rows = [row for row in (comparison.get("by") or {}).get(kind) or [] if row["share_of_excess"] > 0.005]
        shares = ", ".join(f"{row['label']} {100 * row['share_of_excess']:.0f} %" for row in rows)
        split += [f"by {kind:12}{shares}"] if shares else []
    return [*lines, *split, *(["               in % of the error above the noise"] if split else [])]
