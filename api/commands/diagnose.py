"""`stimrig diagnose`: what is missing."""

from __future__ import annotations

from typing import Any

import typer

from api.structure import in_words
from api.terminal import Data, HeldModel, Json, load_held, number, percent, progress_line, say, say_json

VERDICTS = {
    "effect_missing": "An effect is missing in the model.",
    "nothing_missing": "Nothing is missing: what is left looks like noise.",
    "unexplained_structure": "Structure is left that no effect of the library explains.",
}


def register(app: typer.Typer) -> None:
    """Add the verb."""
    app.command("diagnose")(diagnose)


def diagnose(
    data: Data,
    model_json: HeldModel = None,
    as_json: Json = False,
) -> None:
    """What is missing in a model's structure, ranked; or that nothing is; or that it has no name here."""
    import identify

    record, model, structure = load_held(model_json, data)
    progress = progress_line()
    found = {"structure": structure, **identify.diagnose(record, model, progress).to_dict()}
    progress(1.0, "done")
    if as_json:
        say_json(found)
        return
    say(*diagnosis_lines(found))


def diagnosis_lines(found: dict[str, Any]) -> list[str]:
    """A diagnosis for people."""
    base = found["base"]
    lines = [
        VERDICTS.get(found["verdict"], found["verdict"]),
        "",
        f"structure: {in_words(found['structure'])}",
        f"noise          {number(found['noise_sd_nm'], 4)} N·m",
        f"as it is       fit {percent(base.get('fit_percent'))}, rms {number(base.get('rms_nm'), 4)} N·m; "
        f"held out {percent(base.get('held_out_fit_percent'))}, rms {number(base.get('held_out_rms_nm'), 4)} N·m",
    ]
    for effect in found.get("missing") or []:
        lines += ["", *effect_lines(effect)]
    for place in found.get("where") or []:
        low, high = place["pulse_width_us"]
        lines.append(
            f"  {place['segment']}, {place['start_s']:.1f}-{place['end_s']:.1f} s, {low:.0f}-{high:.0f} µs, "
            f"{place['direction'] or 'any direction'}: {100 * place['share_of_excess']:.0f} % of the excess"
        )
    return lines


def effect_lines(effect: dict[str, Any]) -> list[str]:
    """One candidate."""
    lines = [
        f"{effect['effect']}  (probability {number(effect.get('probability'))})",
        f"  rms {number(effect.get('rms_before_nm'), 4)} -> {number(effect.get('rms_after_nm'), 4)} N·m, held out "
        f"{number(effect.get('held_out_rms_before_nm'), 4)} -> {number(effect.get('held_out_rms_after_nm'), 4)} N·m",
    ]
    for name, parameter in (effect.get("parameters") or {}).items():
        value, sd = parameter.get("value"), parameter.get("sd")
        unit = f"{parameter.get('unit') or ''} {parameter.get('direction') or ''}".strip()
        lines.append(f"  {name} {number(value, 4)} ± {number(sd, 4)} {unit}".rstrip())
    if effect.get("confused_with"):
        lines.append(f"  this record cannot tell it from: {', '.join(effect['confused_with'])}")
    if effect.get("next_experiment"):
        lines.append(f"  next experiment: {effect['next_experiment']}")
    return lines
