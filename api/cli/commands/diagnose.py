"""`stimrig diagnose`: what is missing."""

from __future__ import annotations

from typing import Any

from stimrig import identify
from stimrig.api.cli.terminal import (
    ColumnMap,
    HeldModel,
    Json,
    SeveralData,
    load_held,
    number,
    percent,
    repetition_lines,
    say,
    say_json,
)
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words, worded

VERDICTS = {
    "effect_missing": "An effect is missing in the model.",
    "nothing_missing": "Nothing is missing: what is left looks like noise.",
    "unexplained_structure": "The error has structure that no effect of the library explains.",
}


def diagnose(data: SeveralData, model_json: HeldModel = None, columns: ColumnMap = None, as_json: Json = False) -> None:
    """What is missing in a model's structure, most probable first; or nothing; or structure that no effect explains.

    Takes 5 to 30 s, longer where structure is left or with several recordings. DATA decides: a model given with --model
    lends its structure, not its numbers.
    """
    record, model, structure = load_held(model_json, data, columns)
    with progress_bar() as progress:
        found = {"structure": structure, **identify.diagnose(record, model, progress).to_dict()}
    say_json(found) if as_json else say(*diagnosis_lines(found))


def diagnosis_lines(found: dict[str, Any]) -> list[str]:
    """A diagnosis for people."""
    from stimrig.identify.caution import caution
    from stimrig.identify.summary import held_out_label, probability, sure

    base, verdict, doubt = found["base"], found["verdict"], caution(found)
    said = str(VERDICTS.get(verdict, verdict)).rstrip(".")
    certainty = f" (probability {probability(found['probability'])})"
    if doubt:
        said, certainty = "This record cannot tell whether something is missing", ""
    if verdict == "effect_missing":
        said = said.replace(" is ", f" is {sure(found['probability'])} ", 1)
    lines = [
        f"{said}{certainty}.",
        *([doubt] if doubt else []),
        "",
        f"structure      {in_words(found['structure'])}",
        f"noise          {number(found['noise_sd_nm'], 4)} N·m",
        *repetition_lines(base),
        f"the model      fit {percent(base.get('fit_percent'))}, rms {number(base.get('rms_nm'), 4)} N·m; "
        f"{held_out_label(base)} {percent(base.get('held_out_fit_percent'))}, "
        f"rms {number(base.get('held_out_rms_nm'), 4)} N·m",
    ]
    if verdict == "unexplained_structure" and found.get("missing"):
        lines += ["", "Nearest in the library, but not near enough: adding it leaves the structure."]
    for effect in found.get("missing") or []:
        lines += ["", *effect_lines(effect)]
    for row in found.get("free") or []:
        lines += ["", f"{row['effect']}: a free effect; it describes, and names no cause", f"  {row['words']}"]
        lines += [f"  {row['left_out']}"]
    # Where nothing is missing the worst of the noise is no place to look at.
    places = [] if verdict == "nothing_missing" else found.get("where") or []
    if places:
        lines += ["", "worst places, of the fitted rows"]
        lines += [f"  {place['start_s']:.1f}-{place['end_s']:.1f} s, {place['text']}" for place in places]
    lines += ["", *found["notes"]] if found.get("notes") else []
    return [*lines, "", f"next           {next_step(found, doubt)}"]


def next_step(found: dict[str, Any], doubt: str) -> str:
    """What to do with a diagnosis."""
    if found["verdict"] == "unexplained_structure":
        add = "`stimrig improve DATA -o MODEL.json` adds the free effect. " if found.get("free") else ""
        if plan := found.get("deciding_experiment"):
            return f"{add}{worded(plan['text'])} `stimrig test --decide DATA` plays it and judges both together"
        return (
            "look at the worst places and at electrodes, cell and fixture, and record again; an effect of your own: "
            "docs/add-an-effect.md"
        )
    if found["verdict"] == "effect_missing":
        rivals = any(effect.get("confused_with") for effect in found["missing"])
        add = "`stimrig improve DATA -o MODEL.json` adds what is missing, as long as the evidence lasts"
        return f"the next experiment above decides between the rivals; {add}" if rivals else add
    return "record a longer test" if doubt else "nothing to add: use the model of `stimrig fit DATA -o MODEL.json`"


def effect_lines(effect: dict[str, Any]) -> list[str]:
    """One candidate."""
    from stimrig.identify.summary import probability, sure

    p = float(effect.get("probability") or 0.0)
    lines = [
        f"{effect['effect']}: {sure(p)} missing (probability {probability(p)})",
        *([f"  {effect['plain']}"] if effect.get("plain") else []),
        f"  rms {number(effect.get('rms_before_nm'), 4)} -> {number(effect.get('rms_after_nm'), 4)} N·m, held out "
        f"{number(effect.get('held_out_rms_before_nm'), 4)} -> {number(effect.get('held_out_rms_after_nm'), 4)} N·m",
    ]
    for name, parameter in (effect.get("parameters") or {}).items():
        value, sd = parameter.get("value"), parameter.get("sd")
        unit = "" if parameter.get("unit") == "1" else parameter.get("unit") or ""
        unit = f"{unit} {parameter.get('direction') or ''}".strip()
        lines.append(f"  {name} {number(value, 4)} ± {number(sd, 4)} {unit}".rstrip())
    if effect.get("confused_with"):
        lines.append(f"  this record cannot tell it from: {', '.join(effect['confused_with'])}")
    if effect.get("next_experiment"):
        lines.append(f"  next experiment: {worded(effect['next_experiment'])}")
    return lines
