"""What a diagnosis comes to, and what to do next: the one verdict and the one advice that every door shows.

Both are made of the values of the diagnosis alone, so that one that was kept says the same later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from stimrig.identify.yardstick import held_out_pulses

WITHIN_NOISE = 2.5
"""Error on held-out pulses, divided by all noise, up to which there is no warning; slow noise alone gives 1.4."""
OPEN = 0.5
"""Probability that nothing is missing, below which it is left open."""
SURE, LIKELY = 0.9, 0.6
"""Probabilities above which the words are "very probably" and "probably"."""

STRUCTURE_LEFT = "The error has structure that no effect of the library explains"
PART_EXPLAINED = "Effects of the library explain a part of the error only"
UNTOLD = "This record cannot tell whether something is missing"
NOTHING = "Nothing is missing: what is left is noise"


@dataclass(frozen=True)
class Conclusion:
    """The verdict on a model's structure."""

    kind: Literal["missing", "unexplained", "unsure", "nothing"]
    title: str
    words: str
    advice: str  # what to do next


def conclude(found: Mapping[str, Any]) -> Conclusion:
    """The verdict of a diagnosis, for people; `found` has the keys of `diagnose --json`."""
    missing = list(found.get("missing") or [])
    if found["verdict"] == "unexplained_structure" or (found.get("free") and not missing):
        words = "The error depends on what the muscle does, so it is not measurement noise."
        title = STRUCTURE_LEFT if asked_for(found).isdisjoint(row["effect"] for row in missing) else PART_EXPLAINED
        return Conclusion("unexplained", title, _with_error(words, found), _what_describes(found))
    if missing:
        words = f"The record gives evidence for: {join_names(missing)}."
        return Conclusion("missing", _how_many(missing), _with_error(words, found), _what_to_add(found, missing))
    doubt = caution(found)
    if doubt:
        plan = found.get("deciding_experiment")
        further = "Play the next experiment: it is planned to decide." if plan else "Record a longer test."
        return Conclusion("unsure", UNTOLD, doubt, further)
    words = "No effect of the library explains more than noise would."
    return Conclusion("nothing", NOTHING, _with_error(words, found), "Nothing to add.")


def why_ended(found: Mapping[str, Any]) -> str:
    """Why nothing more is learnt from a record whose last model's diagnosis this is; or what still is."""
    said = conclude(found)
    if said.kind in ("missing", "unexplained") and asked_for(found):
        return f"More can be learnt from this record. {said.title}. {said.advice}"
    if said.kind == "nothing":
        return f"Nothing more can be learnt from this record. {said.title}. {said.words}"
    more = {"unexplained": said.words, "missing": said.advice}.get(said.kind, f"{said.words} {said.advice}")
    alone = "Nothing more can be learnt from this record alone."
    return f"{alone} {more}" if said.kind == "unsure" else f"{alone} {said.title}. {more}"


def in_order(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The effects that are missing in the order in which they are to be added; last those that are not to be."""
    missing, order = list(found.get("missing") or []), list(found.get("add") or [])
    return sorted(missing, key=lambda row: order.index(row["effect"]) if row["effect"] in order else len(order))


def asked_for(found: Mapping[str, Any]) -> set[str]:
    """The effects that are to be added; of diagnoses of older versions, all that they name."""
    named = [row["effect"] for key in ("missing", "free") for row in found.get(key) or []]
    return set(found.get("add", named))


def join_names(rows: Sequence[Mapping[str, Any]]) -> str:
    """Names of effects in a sentence."""
    return " and ".join(f"“{row.get('name') or row['effect']}”" for row in rows)


def is_likely(row: Mapping[str, Any]) -> bool:
    """Whether an effect is more than possibly missing: only such a one is advised to be added."""
    return row.get("probability") is None or row["probability"] > LIKELY


def _how_many(missing: Sequence[Mapping[str, Any]]) -> str:
    """How many effects are missing, and how sure that is. Beside a likely one, what is only possible does not count."""
    count = sum(map(is_likely, missing))
    if count:
        return "An effect is missing in this model" if count == 1 else f"{count} effects are missing in this model"
    count = len(missing)
    if count == 1:
        return "An effect is possibly missing in this model"
    return f"{count} effects are possibly missing in this model"


def _what_to_add(found: Mapping[str, Any], missing: Sequence[Mapping[str, Any]]) -> str:
    wanted = asked_for(found)
    asked = [row for row in in_order(found) if row["effect"] in wanted]
    if not asked:
        further = [row["next_experiment"] for row in missing if row.get("next_experiment")][:1]
        return " ".join(["Add nothing yet: held-out pulses speak against adding any.", *further])
    rival = next((row for row in missing if row.get("confused_with")), None)
    first = f"Add {', then '.join(join_names([row]) for row in asked)} to the model."
    return first if rival is None else f"{first} The next experiment tells it from its rivals."


def _what_describes(found: Mapping[str, Any]) -> str:
    wanted = asked_for(found)
    parts = [f"Add {join_names([row])}: it explains a part." for row in in_order(found) if row["effect"] in wanted]
    if found.get("free"):
        parts.append(f"Add {join_names(found['free'])}: it describes what is left, and names no cause.")
    if found.get("deciding_experiment"):
        left = "Play the next experiment: it teaches most about what is left."
        parts.append("The next experiment teaches most about it." if found.get("free") else left)
    return " ".join(parts) or "Look at the worst places and at electrodes, load cell and fixture, and record again."


def only_open(found: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The best candidate (a row of `candidates`) if a good record leaves open whether it is missing; else None.

    Beside a structure that explains much, an effect is only named if it explains a share of that: less may also come
    from the inexact form of the effects in the structure. The record does not show then that nothing is missing.
    """
    tried = found.get("candidates") or ()
    if found["verdict"] != "nothing_missing" or _beyond_noise(found) or not (tried and tried[0]):
        return None
    return tried[0][0] if found.get("probability", 1.0) < OPEN else None


def caution(found: Mapping[str, Any]) -> str:
    """Why "nothing is missing" is not shown by this record; empty where it is, or where the verdict is another.

    The error on held-out pulses is larger than the noise, the best candidate explains too much to be excluded, or what
    the model leaves over is not only noise.
    """
    if found["verdict"] != "nothing_missing":
        return ""
    best = only_open(found)
    if best is not None:
        gain = best["log_evidence_gain"]
        name = best.get("name") or best["effect"]
        between = "too little beside all that is explained, too much for chance"
        return f"{name}: log evidence would rise by {gain:.0f} with it, {between}."
    if beyond := _beyond_noise(found):
        return beyond
    if found.get("residual_check") is False:
        return "Some error is left that is not only noise, but the evidence for each effect of the library is too weak."
    return ""


def _times_noise(found: Mapping[str, Any], noise_nm: float) -> float | None:
    error_nm = (found.get("base") or {}).get("held_out_rms_nm")
    return error_nm / noise_nm if error_nm is not None and noise_nm > 0.0 else None


def _with_error(words: str, found: Mapping[str, Any]) -> str:
    """The words, and the error on held-out pulses in parts of the noise."""
    times = _times_noise(found, found.get("noise_sd_nm") or 0.0)
    where = held_out_pulses(found.get("base") or {})
    return words if times is None else f"{words} On {where} the model's error is {times:.1f} times the noise."


def _beyond_noise(found: Mapping[str, Any]) -> str:
    noise_nm = math.hypot(found["noise_sd_nm"], (found.get("slow_noise") or {}).get("sd_nm") or 0.0)
    times = _times_noise(found, noise_nm)
    if times is None or not times > WITHIN_NOISE:
        return ""
    where = held_out_pulses(found.get("base") or {})
    return (
        f"On {where} the error is {times:.1f} times the noise, and no effect of the library has enough evidence. A "
        "longer record with PRBS, ramp and validate may show what is missing."
    )
