"""Verdict and advice of a diagnosis, the same on the page, in reports and in the command.

Both are made from the values of the diagnosis alone, so a stored diagnosis gives the same words later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from stimrig.identify.yardstick import held_out_pulses

WITHIN_NOISE = 2.5
"""Error on held-out pulses, divided by all noise, up to which there is no warning; slow noise alone gives 1.4."""
OPEN = 0.75
"""Probability that nothing is missing, below which the question is open."""
VERY_PROBABLE, PROBABLE = 0.9, 0.5
"""Probabilities above which the words are "very probably" and "probably"."""

STRUCTURE_LEFT = "The error has structure that no effect of the library explains"
PART_EXPLAINED = "Effects of the library explain a part of the error only"
UNDECIDED = "This record cannot tell whether something is missing"
NOTHING = "Nothing is missing: what is left is noise"


@dataclass(frozen=True)
class Conclusion:
    """The verdict on a model's structure."""

    kind: Literal["missing", "unexplained", "unsure", "nothing"]
    title: str
    words: str
    advice: str  # what to do next


def conclude(diagnosis: Mapping[str, Any]) -> Conclusion:
    """Conclude the verdict of a diagnosis, for people; `diagnosis` has the keys of `diagnose --json`."""
    missing = list(diagnosis.get("missing") or [])
    if diagnosis["verdict"] == "unexplained_structure" or (diagnosis.get("free") and not missing):
        words = "The error depends on what the muscle does, so it is not measurement noise."
        none_to_add = effects_to_add(diagnosis).isdisjoint(row["effect"] for row in missing)
        title = STRUCTURE_LEFT if none_to_add else PART_EXPLAINED
        return Conclusion("unexplained", title, _with_error(words, diagnosis), _advise_unexplained(diagnosis))
    if missing:
        words = f"The record gives evidence for: {join_names(missing)}."
        words, advice = _with_error(words, diagnosis), _advise_effects(diagnosis, missing)
        return Conclusion("missing", _missing_title(missing), words, advice)
    reservation = caution(diagnosis)
    if reservation:
        plan = diagnosis.get("deciding_experiment")
        further = "Play the next experiment: it is planned to decide." if plan else "Record a longer test."
        return Conclusion("unsure", UNDECIDED, reservation, further)
    words = "No effect of the library explains more than noise would."
    return Conclusion("nothing", NOTHING, _with_error(words, diagnosis), "Nothing to add.")


def why_ended(diagnosis: Mapping[str, Any]) -> str:
    """Explain why a search ended, by the diagnosis of its last model; or name what can still be learnt."""
    conclusion = conclude(diagnosis)
    if conclusion.kind in ("missing", "unexplained") and effects_to_add(diagnosis):
        return f"More can be learnt from this record. {conclusion.title}. {conclusion.advice}"
    if conclusion.kind == "nothing":
        return f"Nothing more can be learnt from this record. {conclusion.title}. {conclusion.words}"
    words, advice = conclusion.words, conclusion.advice
    more = {"unexplained": words, "missing": advice}.get(conclusion.kind, f"{words} {advice}")
    alone = "Nothing more can be learnt from this record alone."
    return f"{alone} {more}" if conclusion.kind == "unsure" else f"{alone} {conclusion.title}. {more}"


def in_order(diagnosis: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Sort the missing effects in the order in which they are to be added; those that are not come last."""
    missing, order = list(diagnosis.get("missing") or []), list(diagnosis.get("add") or [])
    return sorted(missing, key=lambda row: order.index(row["effect"]) if row["effect"] in order else len(order))


def effects_to_add(diagnosis: Mapping[str, Any]) -> set[str]:
    """The effects that are to be added; of diagnoses of older versions, all that they name."""
    named = [row["effect"] for key in ("missing", "free") for row in diagnosis.get(key) or []]
    return set(diagnosis.get("add", named))


def join_names(rows: Sequence[Mapping[str, Any]]) -> str:
    """Names of effects in a sentence."""
    return " and ".join(f"“{row.get('name') or row['effect']}”" for row in rows)


def is_likely(row: Mapping[str, Any]) -> bool:
    """Return true if an effect is more than possibly missing; only such an effect is advised."""
    return row.get("probability") is None or row["probability"] > PROBABLE


def _missing_title(missing: Sequence[Mapping[str, Any]]) -> str:
    """Title with the number of missing effects and their certainty; beside likely ones, possible ones do not count."""
    likely = sum(map(is_likely, missing))
    count = likely or len(missing)
    subject = "An effect is" if count == 1 else f"{count} effects are"
    return f"{subject} {'' if likely else 'possibly '}missing in this model"


def _advise_effects(diagnosis: Mapping[str, Any], missing: Sequence[Mapping[str, Any]]) -> str:
    to_add = effects_to_add(diagnosis)
    rows = [row for row in in_order(diagnosis) if row["effect"] in to_add]
    if not rows:
        further = [row["next_experiment"] for row in missing if row.get("next_experiment")][:1]
        if diagnosis.get("deciding_experiment"):
            further.append("Play the next experiment, relaxed: it is planned to decide.")
        return " ".join(["Add nothing yet: held-out pulses speak against adding any.", *further])
    rival = next((row for row in missing if row.get("confused_with")), None)
    first = f"Add {', then '.join(join_names([row]) for row in rows)} to the model."
    if rival is None and diagnosis.get("deciding_experiment"):
        return f"{first} The next experiment teaches most about what is left beside it."
    return first if rival is None else f"{first} The next experiment tells it from its rivals."


def _advise_unexplained(diagnosis: Mapping[str, Any]) -> str:
    to_add = effects_to_add(diagnosis)
    parts = [f"Add {join_names([row])}: it explains a part." for row in in_order(diagnosis) if row["effect"] in to_add]
    if free := diagnosis.get("free"):
        does, names = ("it describes", "names") if len(free) == 1 else ("they describe", "name")
        parts.append(f"Add {join_names(free)}: {does} what is left, and {names} no cause.")
    if diagnosis.get("deciding_experiment"):
        remaining = "Play the next experiment: it teaches most about what is left."
        parts.append("The next experiment teaches most about it." if free else remaining)
    return " ".join(parts) or "Look at the worst places and at electrodes, load cell and fixture, and record again."


def only_open(diagnosis: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the best candidate (a row of `candidates`) if a good record leaves it open; else None.

    Beside a structure that explains much, an effect is only named if it explains a share of that: less may also come
    from the inexact form of the effects in the structure. The record does not show then that nothing is missing.
    """
    tried = diagnosis.get("candidates") or ()
    if diagnosis["verdict"] != "nothing_missing" or _beyond_noise(diagnosis) or not (tried and tried[0]):
        return None
    return tried[0][0] if diagnosis.get("probability", 1.0) < OPEN else None


def caution(diagnosis: Mapping[str, Any]) -> str:
    """Explain why the record does not show that nothing is missing; empty where it does, or for another verdict.

    The error on held-out pulses is larger than the noise, the best candidate explains too much to be excluded, or what
    the model leaves over is not only noise.
    """
    if diagnosis["verdict"] != "nothing_missing":
        return ""
    best = only_open(diagnosis)
    if best is not None:
        gain = best["log_evidence_gain"]
        name = best.get("name") or best["effect"]
        between = "too little beside all that is explained, too much for chance"
        return f"{name}: log evidence would rise by {gain:.0f} with it, {between}."
    if beyond := _beyond_noise(diagnosis):
        return beyond
    if diagnosis.get("residual_check") is False:
        return "Some error is left that is not only noise, but the evidence for each effect of the library is too weak."
    return ""


def _times_noise(diagnosis: Mapping[str, Any]) -> float | None:
    """The error on held-out pulses over all noise, white and slow."""
    noise_nm = math.hypot(diagnosis.get("noise_sd_nm") or 0.0, (diagnosis.get("slow_noise") or {}).get("sd_nm") or 0.0)
    error_nm = (diagnosis.get("base") or {}).get("held_out_rms_nm")
    return error_nm / noise_nm if error_nm is not None and noise_nm > 0.0 else None


def _with_error(words: str, diagnosis: Mapping[str, Any]) -> str:
    """The words, and the error on held-out pulses in parts of the noise."""
    times = _times_noise(diagnosis)
    where = held_out_pulses(diagnosis.get("base") or {})
    return words if times is None else f"{words} On {where} the model's error is {times:.1f} times the noise."


def _beyond_noise(diagnosis: Mapping[str, Any]) -> str:
    times = _times_noise(diagnosis)
    if times is None or not times > WITHIN_NOISE:
        return ""
    where = held_out_pulses(diagnosis.get("base") or {})
    return (
        f"On {where} the error is {times:.1f} times the noise, and no effect of the library has enough evidence. A "
        "longer record with PRBS, ramp and validate may show what is missing."
    )
