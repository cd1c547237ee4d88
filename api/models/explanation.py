"""Why a model fails, as the page and the reports show it: words and numbers put together from what workers found."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from stimrig.api.clinical_words import segment_words
from stimrig.api.effect_words import effect_words, effects_words, parameter_words, within, without_unit
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
"""By so much the error of a model that is fitted anew may differ."""
LEAST_SHARE = 0.005
"""Octaves above the last one with a larger share are not shown."""

PARTS = {
    "f": "f(u), the recruitment curve",
    "G": "G, the linear dynamics",
    "g": "g(x, ẋ), the active torque over angle and velocity",
    "h": "h(x, ẋ), the passive torque over angle and velocity",
}
"""Where an effect stands in the paper's Fig. 2."""


def view(diagnosis: dict[str, Any], comparison: dict[str, Any] | None, effects: Sequence[str]) -> dict[str, Any]:
    """What the section holds.

    `diagnosis`: as `stimrig.api.workers.verbs.diagnosis` gives it, or identify's own; `comparison`: `identify.compare`
    of the model that is looked at; `effects`: effects that this model holds already.
    """
    library = diagnosis.get("library") or {}
    left = _without(diagnosis, effects)
    missing, free = in_order({**diagnosis, **left}), left["free"]
    wanted = asked_for(diagnosis)
    asked = [entry for entry in [*missing, *free] if entry["effect"] in wanted]
    experiment = diagnosis.get("experiment")
    if experiment and experiment["effect"] in effects:
        experiment = None
    said = conclude({**diagnosis, "missing": missing})
    noise = said.kind == "nothing" and not (comparison and stands_out(comparison))
    places = [] if noise else (comparison or {}).get("where") or diagnosis.get("where") or []
    return {
        "kind": said.kind,
        "title": said.title,
        "words": said.words + _mostly_here(places if said.kind == "unexplained" else []),
        "advice": said.advice,
        "missing": [card(entry, library, diagnosis.get("base") or {}) for entry in missing],
        "free": [free_card(entry, library) for entry in free],
        "to_add": [entry["effect"] for entry in asked],
        "likely": [name_of(entry["effect"], library) for entry in asked if is_likely(entry)],
        "structure": effects_words(diagnosis.get("structure") or []) or "plain",
        "places": [place(entry, number) for number, entry in enumerate(places, start=1)],
        "splits": [] if noise else splits(comparison or {}),
        "tests": ((comparison or {}).get("tests") or {}).get("tests") or [],
        "experiment": experiment and tidy_experiment(experiment, library),
        "others": others(diagnosis, effects, library),
        "notes": diagnosis.get("notes") or [],
        "noise_sd_nm": diagnosis.get("noise_sd_nm"),
    }


def remaining(diagnosis: dict[str, Any], effects: Sequence[str], fit: Mapping[str, Any]) -> dict[str, Any]:
    """The diagnosis of a version that holds some of the effects that it names: what is still missing there.

    `fit`: that version's statistics.
    """
    asked = asked_for(diagnosis)
    added = asked & set(effects)
    if not added:
        return diagnosis
    base = diagnosis.get("base") or {}
    found = {
        **diagnosis,
        **_without(diagnosis, added),
        "add": [effect for effect in diagnosis.get("add", sorted(asked)) if effect not in added],
        "base": {**base, **{key: fit[key] for key in base if key in fit}},
    }
    said, structure = conclude(found), [*(diagnosis.get("structure") or []), *sorted(added)]
    told = {"conclusion": asdict(said), "plain": [f"{said.title}. {said.words}", said.advice]}
    return {**found, "structure": structure, **told}


def decided(experiment: dict[str, Any] | None, diagnosis: dict[str, Any], effects: Sequence[str]) -> str:
    """What a further test says of the effects between which it was to decide; empty where it was not to.

    `experiment`: of the diagnosis before the test; `diagnosis`: of the recordings joined; `effects`: that the model
    holds already, one of which may have been added by what the test said.
    """
    rivals = (experiment or {}).get("rivals") or []
    if len(rivals) < 2 or not set(rivals).isdisjoint(effects):
        return ""
    library = diagnosis.get("library") or {}
    named = [row for row in diagnosis["missing"] if row["effect"] in rivals]
    between = {"rivals": " and ".join(_in_a_sentence(rival, library) for rival in rivals)}
    if not named:
        return "The further test was to decide between {rivals}: with it, none of them is asked for.".format(**between)
    if any(not set(row.get("confused_with") or []).isdisjoint(rivals) for row in named):
        return "The further test was to decide between {rivals}: it has not told them apart.".format(**between)
    if len(named) > 1:
        return "The further test was to decide between {rivals}: it asks for more than one of them.".format(**between)
    found = _in_a_sentence(named[0]["effect"], library)
    return "The further test was to decide between {rivals}: it is {found}.".format(**between, found=found)


def _without(diagnosis: dict[str, Any], held: Collection[str]) -> dict[str, list[dict[str, Any]]]:
    """The effects that a diagnosis names, `missing` and `free`, but for those that a model holds."""
    return {
        key: [entry for entry in diagnosis.get(key) or [] if entry["effect"] not in held] for key in ("missing", "free")
    }


def _mostly_here(places: Sequence[dict[str, Any]]) -> str:
    if not places:
        return ""
    return " " + f"It sits mostly here: {place(places[0], 1)['words']}."


def name_of(effect: str, library: dict[str, Any]) -> str:
    """An effect's name for people."""
    return (library.get(effect) or {}).get("name") or effect_words(effect)


def _in_a_sentence(effect: str, library: dict[str, Any]) -> str:
    known = (library.get(effect) or {}).get("name")
    return known.lower() if known else within(effect)


def card(entry: Mapping[str, Any], library: dict[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """One effect that is missing. `base`: this model's errors; an effect found beside another begins at other ones."""
    known = library.get(entry["effect"]) or {}
    rows = (("fitted pulses", ""), ("held-out pulses", "held_out_"))
    errors = [
        (label, before_nm, entry.get(f"{prefix}rms_after_nm"))
        for label, prefix in rows
        if (before_nm := entry.get(f"{prefix}rms_before_nm")) is not None
        and _is_own(before_nm, base.get(f"{prefix}rms_nm"))
    ]
    return {
        **entry,
        "id": entry["effect"],
        "name": entry.get("name") or name_of(entry["effect"], library),
        "objection": entry.get("objection"),
        "sure_words": how_sure(entry.get("probability")),
        "plain": entry.get("plain") or known.get("plain") or "",
        "signature": known.get("signature") or "",
        "equation": entry.get("equation") or known.get("equation") or "",
        "source": known.get("source") or "",
        "part": PARTS.get(known.get("part") or ""),
        "next_experiment": worded(entry.get("next_experiment") or ""),
        "rivals": [_in_a_sentence(rival, library) for rival in entry.get("confused_with") or []],
        "errors": errors,
        "parameters": _labelled(entry.get("parameters") or {}, known, entry.get("form")),
    }  # fmt: skip


def _is_own(before_nm: float, own_nm: float | None) -> bool:
    """Whether an error is that of the model that is looked at: fitted together anew it may be a little another."""
    return own_nm is None or abs(before_nm - own_nm) <= OWN_SHARE * own_nm


def free_card(entry: dict[str, Any], library: dict[str, Any]) -> dict[str, Any]:
    """One free effect: what it does, and its picture."""
    known = library.get(entry["effect"]) or {}
    more = {
        "id": entry["effect"],
        "parameters": _labelled(entry["parameters"], known, entry.get("form")),
        "source": known.get("source"),
    }
    return {**entry, **more}


def held_free(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The free effects that a model holds, as `free_card` gives what a diagnosis found."""
    return [
        {"id": one["id"], "name": effect_words(one["id"]), "equation": one.get("equation") or "", **one["shape"],
         "axis": one["shape"]["effect"], "left_out": "", "parameters": _labelled(one["parameters"], {}, None)}
        for one in document.get("effects") or [] if one.get("shape")
    ]  # fmt: skip


def how_sure(chance: float | None) -> str:
    """A probability that an effect is missing, in words and as a number."""
    if chance is None:
        return ""
    words = {
        "very probably": f"very probably missing · {probability(chance)}",
        "probably": f"probably missing · {probability(chance)}",
        "possibly": f"possibly missing · {probability(chance)}",
    }
    return words[sure(chance)]


def _labelled(parameters: dict[str, Any], known: dict[str, Any], own: str | None) -> dict[str, Any]:
    """Each parameter with what it is in its `own` form, and its name without the unit, as the equation has it."""
    forms = sorted(known.get("forms") or [], key=lambda form: form.get("name") == own)
    about = {one["name"]: one.get("about") or "" for form in forms for one in form["parameters"]}
    return {
        name: {**value, "label": about.get(name, "") or parameter_words(name), "symbol": without_unit(name)}
        for name, value in parameters.items()
    }


def place(entry: dict[str, Any], number: int) -> dict[str, Any]:
    """One of the worst places, with its number in the chart."""
    low, high = entry["pulse_width_us"]
    span = f"{low:.0f} µs" if high - low < 0.5 else f"{low:.0f}–{high:.0f} µs"
    segment = segment_words(entry["segment"])
    ways = {
        "rising": f"{segment}, pulse width rising, {span}",
        "falling": f"{segment}, pulse width falling, {span}",
    }
    words = ways.get(entry.get("direction") or "", f"{segment}, {span}")
    text = entry.get("text") or ""
    what = text.partition(": ")[2].rpartition(", ")[0]
    return {
        **entry,
        "number": number,
        "text": text,
        "words": f"{words}: {what}" if what else words,
        "percent": 100 * entry["share_of_excess"],
    }


def splits(comparison: dict[str, Any]) -> list[dict[str, Any]]:
    """The error in classes, each class with its share of what is left above the noise."""
    by = comparison.get("by") or {}
    found = []
    for kind, title in SPLITS.items():
        say = segment_words if kind == "segment" else str
        rows = [{**row, "words": say(row["label"])} for row in by.get(kind) or []]
        while kind == "frequency" and len(rows) > 1 and rows[-1]["share_of_excess"] < LEAST_SHARE:
            rows.pop()
        if rows:
            most = max(row["share_of_excess"] for row in rows) or 1.0
            found.append({"title": title, "rows": rows, "most": most})
    return found


def tidy_experiment(found: dict[str, Any], library: dict[str, Any]) -> dict[str, Any]:
    """The next experiment for people."""
    return {
        **found,
        "text": worded(found["text"]),
        "names": [_in_a_sentence(rival, library) for rival in found["rivals"]],
        "shown": [
            f"{segment_words(segment['sequence'])} {_seconds(segment['settings'], found.get('pulse_rate_hz'))}".strip()
            for segment in found["segments"]
        ],
    }


def _seconds(settings: dict[str, Any], pulse_rate_hz: float | None) -> str:
    parts = [f"{value:g} s" for key, value in settings.items() if key.endswith("_s")]
    if pulse_rate_hz and (widths := settings.get("pulse_width_us")):
        parts.append(f"{len(widths) / pulse_rate_hz:g} s")
    width = settings.get("max_pulse_width_us")
    times = f" × {settings['repeats']}" if settings.get("repeats", 1) != 1 else ""
    return " + ".join(parts) + times + (f" to {width:g} µs" if width else "")


def others(diagnosis: dict[str, Any], effects: Sequence[str], library: dict[str, Any]) -> list[dict[str, Any]]:
    """Effects that were tried and are not asked for, with the reason, best first."""
    asked = {entry["effect"] for entry in diagnosis["missing"]} | set(effects)
    newest: dict[str, float] = {}
    for rows in diagnosis.get("candidates") or []:
        newest.update({row["effect"]: row["log_evidence_gain"] for row in rows})
    ranked = sorted(newest, key=lambda effect: -newest[effect])
    return [
        {"id": effect, "name": name_of(effect, library), "reason": refusal(diagnosis, effects, effect)
         or "the recording cannot tell it apart from the effects named above."}
        for effect in ranked if effect not in asked
    ]  # fmt: skip


VERSION = (
    "id", "rms_nm", "held_out_rms_nm", "noise_sd_nm", "fit_percent", "held_out_fit_percent", "decision", "served",
    "undone", "added_effect", "effects", "repetition", "reason",
)  # fmt: skip
"""What is shown of a version."""


def versions(rows: Sequence[dict[str, Any]], current: str) -> list[dict[str, Any]]:
    """The versions of one recording in the order in which they descend from each other."""
    return [
        {**{key: row.get(key) for key in VERSION}, "label": label(row), "current": row["id"] == current} for row in rows
    ]


def label(row: dict[str, Any]) -> str:
    """What a version is, beside the one that it was made from."""
    forced = row.get("without_evidence") or ()
    if row["added_effect"]:
        return f"+ {effects_words(row['added_effect'].split(','), forced)}"
    begun_with = effects_words(row.get("effects") or [], forced)
    return f"with {begun_with}" if begun_with else "base model"


def step_versions(found: dict[str, Any]) -> list[dict[str, Any]]:
    """The steps of an improvement as versions."""
    steps = [
        {"id": str(number), "added_effect": step["added"], "noise_sd_nm": found["noise_sd_nm"], "served": False, **step}
        for number, step in enumerate(found["steps"])
    ]
    return versions(steps, "")


# ---- effects that the recording does not ask for --------------------------------------------------------------------


def require_evidence(diagnosis: dict[str, Any], present: Sequence[str], added: Sequence[str]) -> None:
    """Refuse effects that the recording does not ask for. Raises ApiError: 409, with the reason for each effect."""
    if found := refusals(diagnosis, present, added):
        detail = " ".join(f"{effect}: {reason}" for effect, reason in found.items())
        detail += (
            " To add it against the evidence, send `force` and a reason; the held-out error then shows its effect."
        )
        title = "The recording gives no evidence for this effect"
        raise ApiError(409, "effect-not-there", title, detail, reasons=found)


def refusals(diagnosis: dict[str, Any], present: Sequence[str], added: Sequence[str]) -> dict[str, str]:
    """The reason of each effect that the recording does not ask for."""
    return {effect: reason for effect in added if (reason := refusal(diagnosis, present, effect))}


def refusal(diagnosis: dict[str, Any], present: Sequence[str], effect: str) -> str | None:
    """Why the recording does not ask for an effect; None where it does, or cannot tell it from one it asks for.

    It speaks against one that it asks for where rows of `validate` object.
    """
    if effect in [entry["effect"] for entry in diagnosis.get("free") or []]:
        return None
    for entry in diagnosis.get("missing") or []:
        if entry["effect"] == effect:
            return entry.get("objection")
        if effect in (entry.get("confused_with") or []) and entry["effect"] not in present:
            return None
    rows = [row for rows in diagnosis.get("candidates") or [] for row in rows if row["effect"] == effect]
    if not rows:
        return "it was not tested on this recording: the recording lacks the columns that it needs."
    gain = rows[-1]["log_evidence_gain"]
    if rows[-1].get("refusal"):
        return rows[-1]["refusal"]
    if gain <= 0:
        return f"the recording speaks against it (log evidence {gain:+.1f})."
    told = [*(diagnosis.get("missing") or []), *(diagnosis.get("free") or [])]
    better = [entry for entry in told if entry["effect"] != effect]
    if better and rows[0]["log_evidence_gain"] > 6:
        names = " and ".join((entry.get("name") or entry["effect"]).lower() for entry in better)
        name = ((diagnosis.get("library") or {}).get(effect) or {}).get("name", effect).lower()
        beside = f"with it in the model, {name} gains too little (log evidence {gain:+.1f})."
        return f"{names} explains the same error better; {beside}"
    return f"the evidence is too weak (log evidence {gain:+.1f}): what it explains looks like noise."
