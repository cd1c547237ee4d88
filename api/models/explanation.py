"""Why a model fails, as the page and the reports show it: words and numbers put together from what workers found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from api.structure import in_words, worded
from identify.caution import caution

SPLITS = {
    "segment": "By segment",
    "level": "By level of pulse width",
    "direction": "By direction of pulse width",
    "time": "By time since the start",
    "frequency": "By frequency",
}
NOISE_LIKE = 1.3
"""Held-out error over noise up to which what is left passes for noise."""
SURE, LIKELY = 0.9, 0.6
LEAST_SHARE = 0.005
"""Octaves above the last one with a larger share are not shown."""


def view(diagnosis: dict[str, Any], comparison: dict[str, Any] | None, effects: Sequence[str]) -> dict[str, Any]:
    """What the section holds.

    Parameters
    ----------
    diagnosis : dict
        As `api.workers.diagnosis_verbs.diagnosis` gives it, or identify's own.
    comparison : dict or None
        `identify.compare` of the model that is looked at.
    effects : sequence of str
        Effects that this model holds already.
    """
    library = diagnosis.get("library") or {}
    missing = [entry for entry in diagnosis["missing"] if entry["effect"] not in effects]
    places = (comparison or {}).get("where") or diagnosis.get("where") or []
    experiment = diagnosis.get("experiment")
    if experiment and experiment["effect"] in effects:
        experiment = None
    return {
        **headline(diagnosis, missing, comparison, effects),
        "missing": [card(entry, library) for entry in missing],
        "structure": in_words(diagnosis.get("structure") or []),
        "present": [{"id": effect, "name": name_of(effect, library)} for effect in effects],
        "places": [place(entry, number) for number, entry in enumerate(places, start=1)],
        "splits": splits(comparison),
        "tests": ((comparison or {}).get("tests") or {}).get("tests") or [],
        "experiment": experiment and tidy_experiment(experiment, library),
        "others": others(diagnosis, effects, library),
        "notes": diagnosis.get("notes") or [],
        "noise_sd_nm": diagnosis.get("noise_sd_nm"),
    }


def headline(
    diagnosis: dict[str, Any], missing: list[dict[str, Any]], comparison: dict[str, Any] | None, effects: Sequence[str]
) -> dict[str, str]:
    """The verdict on this model: kind, title, sentence."""
    times = times_noise(comparison)
    beside = "" if times is None else f" Its error{_on(comparison)} is {times:.1f} times the noise."
    if diagnosis["verdict"] == "unexplained_structure":
        where = diagnosis.get("where") or []
        sits = f" It sits mostly here: {where[0]['text']}." if where else ""
        words = f"The error depends on what the muscle does, so it is not measurement noise.{sits}{beside}"
        return {
            "kind": "unexplained",
            "title": "The error has structure that no effect of the library explains",
            "words": words,
        }
    if missing:
        names = " and ".join((entry.get("name") or entry["effect"]).lower() for entry in missing)
        many = len(missing) > 1
        sure = " possibly" if max(entry.get("probability") or 1.0 for entry in missing) <= LIKELY else ""
        title = f"{len(missing)} effects are" if many else "An effect is"
        title = f"{title}{sure} missing in this model"
        return {"kind": "missing", "title": title, "words": f"The recording gives evidence for {names}.{beside}"}
    more = " more" if effects else ""
    poor = caution(diagnosis)
    if poor:
        title = "This recording cannot tell whether something is missing"
        return {"kind": "unsure", "title": title, "words": poor}
    if times is not None and times > NOISE_LIKE:
        title = f"No{more} effect of the library has enough evidence in this recording"
        return {
            "kind": "unsure",
            "title": title,
            "words": f"Some error is left, but the evidence for each effect of the library is too weak.{beside}",
        }
    return {
        "kind": "nothing",
        "title": f"Nothing{more} is missing: what is left is noise",
        "words": f"No effect of the library explains more than noise would.{beside}",
    }


def _on(comparison: dict[str, Any] | None) -> str:
    return " on rows not used to fit" if comparison and comparison.get("held_out") else ""


def times_noise(comparison: dict[str, Any] | None) -> float | None:
    """Held-out error (the whole error where nothing is held out) over the noise."""
    if not comparison or not comparison.get("noise_sd_nm"):
        return None
    rows = comparison.get("held_out") or comparison
    return None if rows.get("rms_nm") is None else rows["rms_nm"] / comparison["noise_sd_nm"]


def name_of(effect: str, library: dict[str, Any]) -> str:
    """An effect's name for people."""
    return (library.get(effect) or {}).get("name") or effect.replace("_", " ").capitalize()


def card(entry: dict[str, Any], library: dict[str, Any]) -> dict[str, Any]:
    """One effect that is missing."""
    known = library.get(entry["effect"]) or {}
    probability = entry.get("probability")
    sure = "" if probability is None else "very probably" if probability > SURE else "probably"
    if probability is not None and probability <= LIKELY:
        sure = "possibly"
    errors = [
        (label, entry.get(f"{prefix}rms_before_nm"), entry.get(f"{prefix}rms_after_nm"))
        for label, prefix in (("rows used to fit", ""), ("rows not used to fit", "held_out_"))
    ]
    return {
        **entry,
        "id": entry["effect"],
        "name": entry.get("name") or name_of(entry["effect"], library),
        "sure": sure,
        "plain": entry.get("plain") or known.get("plain") or "",
        "signature": known.get("signature") or "",
        "equation": entry.get("equation") or known.get("equation") or "",
        "source": known.get("source") or "",
        "next_experiment": worded(entry.get("next_experiment") or ""),
        "rivals": [name_of(rival, library).lower() for rival in entry.get("confused_with") or []],
        "errors": [error for error in errors if error[1] is not None],
        "most_nm": max([value for _, *pair in errors for value in pair if value is not None], default=1.0),
        "parameters": {name.rsplit("_", 1)[0] if _ends_in_unit(name) else name: value
                       for name, value in (entry.get("parameters") or {}).items()},
    }  # fmt: skip


def _ends_in_unit(name: str) -> bool:
    return name.endswith(("_s", "_us", "_nm", "_hz", "_rad", "_ms"))


def place(entry: dict[str, Any], number: int) -> dict[str, Any]:
    """One of the worst places, with its number in the chart."""
    low, high = entry["pulse_width_us"]
    words = entry.get("text") or f"{entry['segment']}, {low:.0f}-{high:.0f} µs"
    head, _, tail = words.rpartition(", ")
    return {**entry, "number": number, "words": head or tail, "percent": 100 * entry["share_of_excess"]}


def splits(comparison: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The error in classes, each class with its share of what is left above the noise."""
    by = (comparison or {}).get("by") or {}
    found = []
    for kind, title in SPLITS.items():
        rows = list(by.get(kind) or [])
        while kind == "frequency" and len(rows) > 1 and rows[-1]["share_of_excess"] < LEAST_SHARE:
            rows.pop()
        if rows:
            found.append({"title": title, "rows": rows, "most": max(row["share_of_excess"] for row in rows) or 1.0})
    return found


def tidy_experiment(found: dict[str, Any], library: dict[str, Any]) -> dict[str, Any]:
    """The next experiment for people."""
    return {
        **found,
        "text": worded(found["text"]),
        "names": [name_of(rival, library).lower() for rival in found["rivals"]],
        "shown": [f"{segment['sequence']} {_seconds(segment['settings'])}".strip() for segment in found["segments"]],
    }


def _seconds(settings: dict[str, Any]) -> str:
    parts = [f"{value:g} s" for key, value in settings.items() if key.endswith("_s")]
    width = settings.get("max_pulse_width_us")
    times = f" × {settings['repeats']}" if settings.get("repeats", 1) != 1 else ""
    return " + ".join(parts) + times + (f" to {width:g} µs" if width else "")


def others(diagnosis: dict[str, Any], effects: Sequence[str], library: dict[str, Any]) -> list[dict[str, Any]]:
    """Effects that were tried and are not asked for, with the reason, best first."""
    from api.models.effect_evidence import refusal

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


def versions(rows: Sequence[dict[str, Any]], current: str) -> list[dict[str, Any]]:
    """The versions of one recording in the order in which they descend from each other."""
    return [
        {
            "id": row["id"],
            "label": label(row),
            "current": row["id"] == current,
            **{key: row.get(key) for key in ("rms_nm", "held_out_rms_nm", "noise_sd_nm", "fit_percent")},
            **{key: row.get(key) for key in ("held_out_fit_percent", "decision", "served", "created_utc")},
        }
        for row in rows
    ]


def label(row: dict[str, Any]) -> str:
    """What a version is, beside the one that it was made from."""
    if row["added_effect"]:
        return f"+ {row['added_effect'].replace('_', ' ')}"
    begun_with = ", ".join(row.get("effects") or []).replace("_", " ")
    return f"with {begun_with}" if begun_with else "base model"


def of_steps(found: dict[str, Any]) -> list[dict[str, Any]]:
    """The steps of an improvement as versions."""
    rows = [
        {"id": str(number), "added_effect": step["added"], "noise_sd_nm": found["noise_sd_nm"], **step}
        for number, step in enumerate(found["steps"])
    ]
    shown = versions([{"created_utc": None, "decision": None, "served": False, **row} for row in rows], "")
    return [{**row, "reason": step.get("reason", "")} for row, step in zip(shown, found["steps"], strict=True)]


def noisy(comparison: dict[str, Any]) -> bool:
    """Whether more is left than noise would leave."""
    times = times_noise(comparison)
    return times is not None and times > NOISE_LIKE
