"""Explains why a model fails, for the page and the reports: words and numbers from the workers' results."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from stimrig.api.clinical_words import segment_words
from stimrig.api.effect_words import effect_words, effects_words, parameter_words, without_unit
from stimrig.api.structure import worded
from stimrig.identify.conclusion import conclude, effects_to_add, in_order, is_likely
from stimrig.identify.healing import stands_out
from stimrig.identify.summary import error_change, parameters_words, probability, probability_words, stretch_words

SPLITS = {
    "segment": "By part of the test",
    "level": "By level of pulse width",
    "direction": "By direction of pulse width",
    "time": "By time since the start",
    "frequency": "By frequency",
}
OWN_SHARE = 0.05
"""Share by which the error of a model may differ after a new fit."""
LEAST_SHARE = 0.005
"""Octaves above the last one with a larger share are not shown."""
PARTS = {
    "f": "f(u), the recruitment curve",
    "G": "G, the linear dynamics",
    "g": "g(x, ẋ), the active torque over angle and velocity",
    "h": "h(x, ẋ), the passive torque over angle and velocity",
}
"""Position of an effect in the paper's Fig. 2."""
NOT_TESTED = "It was not tested on this recording: the recording lacks the columns that it needs."


def view(diagnosis: Mapping[str, Any], comparison: Mapping[str, Any] | None) -> dict[str, Any]:
    """Prepare a diagnosis for the page and the reports.

    `diagnosis`: as the verb `diagnosis` of the workers gives it; `comparison`: `identify.compare` of the same model.
    """
    library, missing, free = diagnosis.get("library") or {}, in_order(diagnosis), diagnosis.get("free") or []
    wanted, conclusion, compared = effects_to_add(diagnosis), conclude(diagnosis), comparison or {}
    to_add = [entry for entry in [*missing, *free] if entry["effect"] in wanted]
    noise = conclusion.kind == "nothing" and not (comparison and stands_out(comparison))
    where = [] if noise else compared.get("where") or diagnosis.get("where") or []
    places = [place(entry, number) for number, entry in enumerate(where, start=1)]
    mostly = f" It sits mostly here: {places[0]['words']}." if places and conclusion.kind == "unexplained" else ""
    experiment, named = diagnosis.get("experiment"), {entry["effect"] for entry in [*missing, *free]}
    return {
        **asdict(conclusion),
        "words": conclusion.words + mostly,
        "missing": [card(entry, library, diagnosis.get("base") or {}) for entry in missing],
        "free": [free_card(entry, library, entry["name"]) for entry in free],
        "with_all": diagnosis.get("with_all") if free else None,
        "to_add": [entry["effect"] for entry in to_add],
        "likely": [name_of(entry["effect"], library) for entry in to_add if is_likely(entry)],
        "structure": effects_words(diagnosis.get("structure") or []) or "plain",
        "places": places,
        "splits": [] if noise else splits(compared),
        "tests": (compared.get("tests") or {}).get("tests", []),
        "experiment": experiment and tidy_experiment(experiment),
        "table": [change(row, named) for row in diagnosis.get("table") or []],
        "others": [
            {"id": row["effect"], "name": name_of(row["effect"], library)}
            for row in diagnosis.get("refused") or []
            if row["effect"] not in named
        ],
        "notes": diagnosis.get("notes") or [],
        "noise_sd_nm": diagnosis.get("noise_sd_nm"),
    }


def refusals(diagnosis: Mapping[str, Any], added: Sequence[str]) -> dict[str, str]:
    """Return why the recording gives no evidence for these effects; an effect without a reason is left out.

    There is none against an effect that cannot be told from one that is asked for.
    """
    reasons = dict.fromkeys(added, NOT_TESTED)
    reasons |= {row["effect"]: row["reason"] for row in diagnosis.get("refused") or []}
    reasons |= {row["effect"]: "" for row in diagnosis.get("free") or []}
    for row in diagnosis["missing"]:
        reasons |= dict.fromkeys(row.get("confused_with") or [], "")
    reasons |= {row["effect"]: row.get("objection") or "" for row in diagnosis["missing"]}
    return {effect: reasons[effect] for effect in added if reasons[effect]}


# ---- effects --------------------------------------------------------------------------------------------------------


def name_of(effect: str, library: Mapping[str, Any]) -> str:
    """Return the display name of an effect."""
    return (library.get(effect) or {}).get("name") or effect_words(effect)


def change(row: Mapping[str, Any], explained: Collection[str]) -> dict[str, Any]:
    """Put a row of a diagnosis's table into words; `explained`: effects that are described below it."""
    parts = [parameters_words(row["parameters"])] * bool(row["parameters"]) + stretch_words(row)
    return {
        **row,
        "label": row["name"] if row["effect"] else "No change: nothing is missing",
        "change": error_change(row).replace("-", "−") or "–",
        "chance": "–" if row["probability"] is None else probability(row["probability"]),
        "about": " ".join([f"{'; '.join(parts)}." if parts else "", row["reason"]]).strip(),
        "explained": row["effect"] in explained,
    }


def card(entry: Mapping[str, Any], library: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Describe an effect that is missing. `base`: the errors of this model.

    An effect that was found beside another one begins at other errors: these are left out.
    """
    known, chance = library.get(entry["effect"]) or {}, entry.get("probability")
    errors = []
    for label, prefix in (("fitted pulses", ""), ("held-out pulses", "held_out_")):
        before_nm, own_nm = entry.get(f"{prefix}rms_before_nm"), base.get(f"{prefix}rms_nm")
        if before_nm is not None and (own_nm is None or abs(before_nm - own_nm) <= OWN_SHARE * own_nm):
            errors.append((label, before_nm, entry[f"{prefix}rms_after_nm"]))
    name, rivals = entry.get("name") or name_of(entry["effect"], library), entry.get("confused_with") or []
    signature, part = known.get("signature"), PARTS.get(known.get("part") or "")
    notes = [
        signature and f"What it looks like in the error: {signature}",
        entry.get("objection"),
        rivals and worded(entry.get("next_experiment") or ""),
        part and f"In the paper's Fig. 2 it stands in {part}.",
    ]
    return {
        "plain": "",
        "equation": "",
        **entry,
        "id": entry["effect"],
        "name": name,
        "heading": f"The missing effect: {name}",
        "sure_words": "" if chance is None else f"{probability_words(chance)} missing · {probability(chance)}",
        "notes": [words for words in notes if words],
        "source": known.get("source"),
        "rivals": [name[:1].lower() + name[1:] for name in (name_of(rival, library) for rival in rivals)],
        "errors": errors,
        "parameters": _labelled(entry, library),
    }


def free_card(entry: Mapping[str, Any], library: Mapping[str, Any], heading: str) -> dict[str, Any]:
    """Describe a free effect, of a diagnosis or of a model."""
    about = "A free effect: it describes what no effect of the library explains, and names no cause."
    parameters, plain = _labelled(entry, library), f"{entry['words']} {entry.get('left_out') or ''}".strip()
    card = {"heading": heading, "plain": plain, "notes": [about], "source": None, "parameters": parameters}
    return {"equation": "", **entry, **card, "id": entry["effect"]}


def held_free(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Describe the free effects of a model as `view` does those of a diagnosis."""
    cards = []
    for effect in document.get("effects") or []:
        if shape := effect.get("shape"):
            naming = {"effect": effect["id"], "name": effect_words(effect["id"]), "axis": shape["effect"]}
            entry = {**{key: effect[key] for key in ("equation", "parameters") if key in effect}, **shape, **naming}
            cards.append(free_card(entry, {}, f"In this model: {naming['name']}"))
    return cards


def _labelled(entry: Mapping[str, Any], library: Mapping[str, Any]) -> dict[str, Any]:
    """Label each parameter of an effect with its meaning in this form and its symbol in the equation."""
    known = (library.get(entry["effect"]) or {}).get("forms") or []
    forms = sorted(known, key=lambda each: each.get("name") == entry.get("form"))
    about = {parameter["name"]: parameter.get("about") or "" for each in forms for parameter in each["parameters"]}
    return {
        name: {**value, "label": about.get(name, "") or parameter_words(name), "symbol": without_unit(name)}
        for name, value in (entry.get("parameters") or {}).items()
    }


# ---- the error ------------------------------------------------------------------------------------------------------


def place(entry: Mapping[str, Any], number: int) -> dict[str, Any]:
    """Describe one of the worst places, with its number in the chart."""
    low, high = entry["pulse_width_us"]
    direction, text = entry.get("direction"), entry.get("text") or ""
    parts = [
        segment_words(entry["segment"]),
        *([f"pulse width {direction}"] if direction in ("rising", "falling") else []),
        f"{low:.0f} µs" if high - low < 0.5 else f"{low:.0f}–{high:.0f} µs",
    ]
    error = text.partition(": ")[2].rpartition(", ")[0]
    words = ", ".join(parts) + (f": {error}" if error else "")
    return {**entry, "number": number, "text": text, "words": words, "percent": 100 * entry["share_of_excess"]}


def splits(comparison: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Split the error into classes, each class with its share of what is left above the noise."""
    tables = []
    for kind, title in SPLITS.items():
        rows = list((comparison.get("by") or {}).get(kind) or [])
        while kind == "frequency" and len(rows) > 1 and rows[-1]["share_of_excess"] < LEAST_SHARE:
            rows.pop()
        if rows:
            words = segment_words if kind == "segment" else str
            named = [{**row, "words": words(row["label"])} for row in rows]
            tables.append({"title": title, "rows": named, "most": max(row["share_of_excess"] for row in rows) or 1.0})
    return tables


def tidy_experiment(experiment: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the next experiment for people."""
    rate_hz = experiment.get("pulse_rate_hz")
    played = [(segment_words(row["sequence"]), _seconds(row["settings"], rate_hz)) for row in experiment["segments"]]
    segments = [f"{name} {seconds}".strip() for name, seconds in played]
    return {**experiment, "text": worded(experiment["text"]), "shown": segments}


def _seconds(settings: Mapping[str, Any], pulse_rate_hz: float | None) -> str:
    parts = [f"{value:g} s" for key, value in settings.items() if key.endswith("_s")]
    if pulse_rate_hz and (widths := settings.get("pulse_width_us")):
        parts.append(f"{len(widths) / pulse_rate_hz:g} s")
    width = settings.get("max_pulse_width_us")
    times = f" × {settings['repeats']}" if settings.get("repeats", 1) != 1 else ""
    return " + ".join(parts) + times + (f" to {width:g} µs" if width else "")


# ---- versions -------------------------------------------------------------------------------------------------------


def versions(rows: Sequence[Mapping[str, Any]], current: str) -> list[dict[str, Any]]:
    """List the versions of one recording in order of descent, each named by what it has beside its parent."""
    return [{"reason": None, **row, "label": _label(row), "current": row["id"] == current} for row in rows]


def _label(row: Mapping[str, Any]) -> str:
    forced = row.get("without_evidence") or ()
    if row["added_effect"]:
        return f"+ {effects_words(row['added_effect'].split(','), forced)}"
    begun_with = effects_words(row.get("effects") or [], forced)
    return f"with {begun_with}" if begun_with else "base model"


def step_versions(improvement: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the steps of an improvement as versions."""
    undecided = {"decision": None, "served": False, "noise_sd_nm": improvement["noise_sd_nm"]}
    steps = enumerate(improvement["steps"])
    return versions(
        [{"id": str(number), "added_effect": step["added"], **undecided, **step} for number, step in steps], ""
    )
