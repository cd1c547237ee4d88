"""Explains why a model fails, for the page and the reports: words and numbers from the workers' results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from stimrig.api.clinical_words import segment_words
from stimrig.api.effect_words import effect_words, effects_words, parameter_words, without_unit
from stimrig.api.errors import ApiError
from stimrig.api.structure import worded
from stimrig.identify.conclusion import asked_for, conclude, in_order, is_likely
from stimrig.identify.healing import stands_out
from stimrig.identify.summary import probability, sure

SPLITS: dict[str, str] = {
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


def view(diagnosis: Mapping[str, Any], comparison: Mapping[str, Any] | None) -> dict[str, Any]:
    """Prepare a diagnosis for the page and the reports.

    `diagnosis`: as the verb `diagnosis` of the workers gives it; `comparison`: `identify.compare` of the same model.
    """
    library, base = diagnosis.get("library") or {}, diagnosis.get("base") or {}
    missing, free = in_order(diagnosis), diagnosis.get("free") or []
    wanted = asked_for(diagnosis)
    to_add = [entry for entry in [*missing, *free] if entry["effect"] in wanted]
    conclusion = conclude(diagnosis)
    noise = conclusion.kind == "nothing" and not (comparison and stands_out(comparison))
    compared = comparison or {}
    where = [] if noise else compared.get("where") or diagnosis.get("where") or []
    places = [place(entry, number) for number, entry in enumerate(where, start=1)]
    mostly = f" It sits mostly here: {places[0]['words']}." if places and conclusion.kind == "unexplained" else ""
    experiment = diagnosis.get("experiment")
    return {
        "kind": conclusion.kind,
        "title": conclusion.title,
        "words": conclusion.words + mostly,
        "advice": conclusion.advice,
        "missing": [card(entry, library, base) for entry in missing],
        "free": [free_card(entry, library) for entry in free],
        "to_add": [entry["effect"] for entry in to_add],
        "likely": [name_of(entry["effect"], library) for entry in to_add if is_likely(entry)],
        "structure": effects_words(diagnosis.get("structure") or []) or "plain",
        "places": places,
        "splits": [] if noise else splits(compared),
        "tests": (compared.get("tests") or {}).get("tests", []),
        "experiment": experiment and tidy_experiment(experiment, library),
        "others": others(diagnosis, library),
        "notes": diagnosis.get("notes") or [],
        "noise_sd_nm": diagnosis.get("noise_sd_nm"),
    }


def remaining(diagnosis: dict[str, Any], effects: Sequence[str], fit: Mapping[str, Any]) -> dict[str, Any]:
    """Reduce a diagnosis to what is still missing in a version that has some of the effects it names.

    `fit`: the statistics of that version.
    """
    named = {entry["effect"] for key in ("missing", "free") for entry in diagnosis.get(key) or []}
    included = named & set(effects)
    if not included:
        return diagnosis
    base, experiment = diagnosis.get("base") or {}, diagnosis.get("experiment")
    reduced = {
        **diagnosis,
        **{
            key: [row for row in diagnosis.get(key) or [] if row["effect"] not in included]
            for key in ("missing", "free")
        },
        "add": [effect for effect in diagnosis.get("add", sorted(named)) if effect not in included],
        "base": {**base, **{key: fit[key] for key in base if key in fit}},
        "structure": [*(diagnosis.get("structure") or []), *sorted(included)],
        "experiment": None if experiment and experiment["effect"] in included else experiment,
    }
    conclusion = conclude(reduced)
    plain = [f"{conclusion.title}. {conclusion.words}", conclusion.advice]
    return {**reduced, "conclusion": asdict(conclusion), "plain": plain}


def decided(experiment: Mapping[str, Any] | None, diagnosis: Mapping[str, Any], effects: Sequence[str]) -> str:
    """Say what a further test found of the effects between which it was to decide; empty where it was not to.

    `experiment`: of the diagnosis before the test; `diagnosis`: of the recordings joined; `effects`: that the model
    holds already, one of which may have been added by what the test said.
    """
    rivals = (experiment or {}).get("rivals") or []
    if len(rivals) < 2 or not set(rivals).isdisjoint(effects):
        return ""
    library = diagnosis.get("library") or {}
    named = [row for row in diagnosis["missing"] if row["effect"] in rivals]
    if not named:
        answer = "with it, none of them is asked for"
    elif any(not set(row.get("confused_with") or []).isdisjoint(rivals) for row in named):
        answer = "it has not told them apart"
    elif len(named) > 1:
        answer = "it asks for more than one of them"
    else:
        answer = f"it is {_in_a_sentence(named[0]['effect'], library)}"
    between = " and ".join(_in_a_sentence(rival, library) for rival in rivals)
    return f"The further test was to decide between {between}: {answer}."


def name_of(effect: str, library: Mapping[str, Any]) -> str:
    """Return the display name of an effect."""
    return (library.get(effect) or {}).get("name") or effect_words(effect)


def _in_a_sentence(effect: str, library: Mapping[str, Any]) -> str:
    name = name_of(effect, library)
    return name[:1].lower() + name[1:]


def card(entry: Mapping[str, Any], library: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Describe an effect that is missing. `base`: the errors of this model.

    An effect that was found beside another one begins at other errors: these are left out.
    """
    known = library.get(entry["effect"]) or {}
    errors = []
    for label, prefix in (("fitted pulses", ""), ("held-out pulses", "held_out_")):
        before_nm, own_nm = entry.get(f"{prefix}rms_before_nm"), base.get(f"{prefix}rms_nm")
        if before_nm is not None and (own_nm is None or abs(before_nm - own_nm) <= OWN_SHARE * own_nm):
            errors.append((label, before_nm, entry[f"{prefix}rms_after_nm"]))
    return {
        **entry,
        "id": entry["effect"],
        "name": entry.get("name") or name_of(entry["effect"], library),
        "objection": entry.get("objection"),
        "sure_words": how_sure(entry.get("probability")),
        "plain": entry.get("plain") or "",
        "signature": known.get("signature") or "",
        "equation": entry.get("equation") or "",
        "source": known.get("source") or "",
        "part": PARTS.get(known.get("part") or ""),
        "next_experiment": worded(entry.get("next_experiment") or ""),
        "rivals": [_in_a_sentence(rival, library) for rival in entry.get("confused_with") or []],
        "errors": errors,
        "parameters": _labelled(entry.get("parameters") or {}, known, entry.get("form")),
    }


def free_card(entry: Mapping[str, Any], library: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a free effect: what it does, and its picture."""
    known = library.get(entry["effect"]) or {}
    parameters = _labelled(entry["parameters"], known, entry.get("form"))
    return {**entry, "id": entry["effect"], "parameters": parameters}


def held_free(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Describe the free effects of a model as `free_card` does those of a diagnosis."""
    return [
        {
            "id": effect["id"],
            "name": effect_words(effect["id"]),
            "equation": effect.get("equation") or "",
            **effect["shape"],
            "axis": effect["shape"]["effect"],
            "left_out": "",
            "parameters": _labelled(effect["parameters"], {}, None),
        }
        for effect in document.get("effects") or []
        if effect.get("shape")
    ]


def how_sure(chance: float | None) -> str:
    """Format the probability that an effect is missing, in words and as a number."""
    return "" if chance is None else f"{sure(chance)} missing · {probability(chance)}"


def _labelled(parameters: Mapping[str, Any], known: Mapping[str, Any], form: str | None) -> dict[str, Any]:
    """Label each parameter with its meaning in this form and its symbol in the equation."""
    forms = sorted(known.get("forms") or [], key=lambda each: each.get("name") == form)
    about = {parameter["name"]: parameter.get("about") or "" for each in forms for parameter in each["parameters"]}
    return {
        name: {**value, "label": about.get(name, "") or parameter_words(name), "symbol": without_unit(name)}
        for name, value in parameters.items()
    }


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
            named = [
                {**row, "words": segment_words(row["label"]) if kind == "segment" else row["label"]} for row in rows
            ]
            largest_share = max(row["share_of_excess"] for row in rows) or 1.0
            tables.append({"title": title, "rows": named, "most": largest_share})
    return tables


def tidy_experiment(experiment: Mapping[str, Any], library: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the next experiment for people."""
    rate_hz = experiment.get("pulse_rate_hz")
    played = [(segment_words(row["sequence"]), _seconds(row["settings"], rate_hz)) for row in experiment["segments"]]
    return {
        **experiment,
        "text": worded(experiment["text"]),
        "names": [_in_a_sentence(rival, library) for rival in experiment["rivals"]],
        "shown": [f"{name} {seconds}".strip() for name, seconds in played],
    }


def _seconds(settings: Mapping[str, Any], pulse_rate_hz: float | None) -> str:
    parts = [f"{value:g} s" for key, value in settings.items() if key.endswith("_s")]
    if pulse_rate_hz and (widths := settings.get("pulse_width_us")):
        parts.append(f"{len(widths) / pulse_rate_hz:g} s")
    width = settings.get("max_pulse_width_us")
    times = f" × {settings['repeats']}" if settings.get("repeats", 1) != 1 else ""
    return " + ".join(parts) + times + (f" to {width:g} µs" if width else "")


def others(diagnosis: Mapping[str, Any], library: Mapping[str, Any]) -> list[dict[str, Any]]:
    """List the effects that were tried and rejected, with the reason, best first."""
    named = {entry["effect"] for entry in diagnosis["missing"]}
    return [
        {"id": row["effect"], "name": name_of(row["effect"], library), "reason": row["reason"]}
        for row in diagnosis.get("refused") or []
        if row["effect"] not in named
    ]


def versions(rows: Sequence[Mapping[str, Any]], current: str) -> list[dict[str, Any]]:
    """List the versions of one recording in order of descent."""
    return [{"reason": None, **row, "label": label(row), "current": row["id"] == current} for row in rows]


def label(row: Mapping[str, Any]) -> str:
    """Name a version by what it has beside the one that it was made from."""
    forced = row.get("without_evidence") or ()
    if row["added_effect"]:
        return f"+ {effects_words(row['added_effect'].split(','), forced)}"
    begun_with = effects_words(row.get("effects") or [], forced)
    return f"with {begun_with}" if begun_with else "base model"


def step_versions(improvement: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the steps of an improvement as versions."""
    undecided = {"decision": None, "served": False, "undone": False, "noise_sd_nm": improvement["noise_sd_nm"]}
    steps = enumerate(improvement["steps"])
    return versions(
        [{"id": str(number), "added_effect": step["added"], **undecided, **step} for number, step in steps], ""
    )


# ---- effects that the recording does not ask for --------------------------------------------------------------------

NOT_TESTED = "It was not tested on this recording: the recording lacks the columns that it needs."


def require_evidence(diagnosis: Mapping[str, Any], added: Sequence[str]) -> None:
    """Refuse effects that the recording does not ask for. Raises ApiError: 409, with the reason for each effect."""
    if reasons := refusals(diagnosis, added):
        detail = " ".join(f"{effect}: {reason}" for effect, reason in reasons.items())
        detail += (
            " To add it against the evidence, send `force` and a reason; the held-out error then shows its effect."
        )
        title = "The recording gives no evidence for this effect"
        raise ApiError(409, "effect-not-there", title, detail, reasons=reasons)


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
