"""`stimrig diagnose`: what is missing."""

from __future__ import annotations

from typing import Any

from stimrig import identify
from stimrig.api.cli.files import load_structure
from stimrig.api.cli.options import ColumnMap, HeldModel, Json, SeveralData
from stimrig.api.cli.reports import repetition_lines
from stimrig.api.cli.terminal import number, percent, say, say_json
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words, worded


def diagnose(data: SeveralData, model_json: HeldModel = None, columns: ColumnMap = None, as_json: Json = False) -> None:
    """What is missing in a model's structure, most probable first; or nothing; or structure that no effect explains.

    Takes 5 to 30 s, longer where structure is left or with several recordings. DATA decides: a model given with --model
    lends its structure, not its numbers.
    """
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        diagnosis = identify.diagnose(record, model, progress)
    document = {"structure": structure, **diagnosis.to_dict()}
    if as_json:
        say_json(document)
        return
    say(*diagnosis_lines(document))


def diagnosis_lines(diagnosis: dict[str, Any]) -> list[str]:
    """Write a diagnosis for people."""
    from stimrig.identify.conclusion import conclude
    from stimrig.identify.summary import certainty, held_out_label

    base, verdict, conclusion = diagnosis["base"], diagnosis["verdict"], conclude(diagnosis)
    lines = [
        f"{conclusion.title}{certainty(diagnosis)}.",
        conclusion.words,
        "",
        f"structure      {in_words(diagnosis['structure'])}",
        f"noise          {number(diagnosis['noise_sd_nm'], 4)} N·m",
        *repetition_lines(base),
        f"the model      fit {percent(base.get('fit_percent'))}, error {number(base.get('rms_nm'), 4)} N·m; "
        f"{held_out_label(base)} fit {percent(base.get('held_out_fit_percent'))}, "
        f"error {number(base.get('held_out_rms_nm'), 4)} N·m",
    ]
    if verdict == "unexplained_structure" and diagnosis.get("missing"):
        lines += ["", "Nearest in the library, but not near enough: adding it leaves the structure."]
    for effect in diagnosis.get("missing") or []:
        lines += ["", *effect_lines(effect)]
    for row in diagnosis.get("free") or []:
        lines += ["", f"{row['effect']}: a free effect; it describes, and names no cause", f"  {row['words']}"]
        lines += [f"  {row['left_out']}"]
    # Where nothing is missing the worst of the noise is no place to look at.
    places = [] if conclusion.kind == "nothing" else diagnosis.get("where") or []
    if places:
        lines += ["", "worst places"]
        lines += [f"  {place['start_s']:.1f}-{place['end_s']:.1f} s, {place['text']}" for place in places]
    lines += ["", *diagnosis["notes"]] if diagnosis.get("notes") else []
    return [*lines, "", f"next           {conclusion.advice} {_command(diagnosis, conclusion.kind)}".rstrip()]


def _command(diagnosis: dict[str, Any], kind: str) -> str:
    """Name the commands that do what is advised."""
    if kind == "nothing":
        return "The model is that of `stimrig fit DATA -o MODEL.json`."
    play = "`stimrig test --decide DATA` plays the next experiment." if diagnosis.get("deciding_experiment") else ""
    add = "`stimrig explain DATA -o MODEL.json` adds, and shows how the error falls." if diagnosis.get("add") else ""
    extension = "An effect of your own: docs/add-an-effect.md." if kind == "unexplained" and not add else ""
    return " ".join(filter(None, (add, play, extension)))


def effect_lines(effect: dict[str, Any]) -> list[str]:
    """Write one candidate."""
    from stimrig.identify.summary import probability, sure

    p = float(effect.get("probability") or 0.0)
    lines = [
        f"{effect['effect']}: {sure(p)} missing (probability {probability(p)})",
        *([f"  {effect['plain']}"] if effect.get("plain") else []),
        f"  error {number(effect.get('rms_before_nm'), 4)} -> {number(effect.get('rms_after_nm'), 4)} N·m, held out "
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
