"""MODEL.json: the bytes as they were stored, and what a person reads off it."""

from __future__ import annotations

import cmath
import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from stimrig.api.effect_words import fact_of
from stimrig.api.errors import ApiError
from stimrig.identify.yardstick import contradiction_words, repetition_sentences

if TYPE_CHECKING:
    from stimrig.api.store.tables import Model

UNDEFINED = "not defined: the torque is level there"
"""Placeholder for a model that has an error but no best-fit %."""
NO_VERDICT = {"verdict": "unknown", "words": "No verdict was stored with this model: fit it again.", "reasons": []}
FIT = (
    "fit_percent", "ceiling_percent", "held_out_fit_percent", "held_out_ceiling_percent",
    "rms_nm", "held_out_rms_nm", "held_out_by", "noise_sd_nm",
)  # fmt: skip
Figure = dict[str, Any]
"""`value`, `sd` (None: not known) and `unit`; of an effect's parameter, the effect's `form` besides."""
UNITS = {"threshold_us": "µs", "plateau_nm": "N·m", "time_constant_s": "s", "damping": "1", "delay_s": "s"}
"""Figures that are followed over sessions."""


def whole(row: Model) -> bytes:
    """Return a version's bytes, for the controller and for files. Raises ApiError (500): they are damaged."""
    if hashlib.sha256(row.document).hexdigest() != row.etag:
        detail = (
            f"{row.id} is no longer what was stored (its checksum differs). Restore the database from a backup, or fit "
            "its recording again."
        )
        raise ApiError(500, "model-damaged", "The stored model is damaged", detail)
    return row.document


def read(row: Model) -> dict[str, Any]:
    """Return a version's document. Raises ApiError (500): it is damaged."""
    return json.loads(whole(row))


def text(row: Model) -> str:
    """Return a version's document as workers are given it. Raises ApiError (500): it is damaged."""
    return whole(row).decode()


def structure(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the effects of a model, each with its form where it has one: `id:form`."""
    forms = {effect["id"]: effect.get("form") or "" for effect in document.get("effects") or []}
    return {name: f"{name}:{form}".removesuffix(":") for name, form in forms.items()}


def is_plain(document: Mapping[str, Any]) -> bool:
    """Return whether the structure is the plain one: no effects around f(u) and a G of second order."""
    return not structure(document) and "time_constant_s" in document["linear"]


# ---- verdict and fit ----------------------------------------------------------------------------------------------


def repetition(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the repetition statistics of a MODEL.json, with `sentences` and `contradiction`; None for unknown ones."""
    statistics = document["fit"].get("repetition") or dict.fromkeys(("found_by", "rms_nm", "explained_percent"))
    contradicts = contradiction_words(document["fit"].get("contradiction"))
    return {**statistics, "sentences": repetition_sentences(document["fit"]), "contradiction": contradicts}


def figures(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the headline figures of a MODEL.json."""
    return {name: document["fit"].get(name) for name in FIT}


def quality(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the verdict of identify: `verdict`, `words` (a sentence) and `reasons`; "unknown" without one."""
    stored = document.get("quality") or NO_VERDICT
    return {name: stored[name] for name in NO_VERDICT}


def without_evidence(document: Mapping[str, Any]) -> list[str]:
    """Return the effects of a model that a person added although the recording did not ask for them."""
    return (document.get("quality") or {}).get("gates", {}).get("evidence", {}).get("effects", [])


def mark_without_evidence(document: dict[str, Any], effects: Sequence[str]) -> None:
    """Mark a version with effects added without evidence: its verdict is "usable with care" at best."""
    if not effects:
        return
    judged, reason = document["quality"], f"added without evidence: {', '.join(effects)}"
    judged["gates"]["evidence"] = {"passed": False, "severity": "care", "says": reason, "effects": list(effects)}
    judged["reasons"] = [*judged["reasons"], reason]
    if judged["verdict"] == "usable":
        judged |= {"verdict": "usable with care", "words": f"{reason.capitalize()}."}


class Followed(NamedTuple):
    """Share of the torque that a model explains, %; None where it is not defined."""

    percent: float | None
    ceiling_percent: float | None  # what the sensor noise allows on the same pulses
    where: str  # the pulses it was found on, as the beginning of a sentence
    held_out: bool = True


def followed(fit: Mapping[str, Any]) -> Followed:
    """Return the one figure of merit of every page: of pulses not used for fitting where there are any."""
    if fit.get("held_out_fit_percent") is None:
        where = "On the pulses that it was fitted to"
        return Followed(fit.get("fit_percent"), fit.get("ceiling_percent"), where, held_out=False)
    by_parts = fit.get("held_out_by") == "cross-validation"
    parts, pulses = "On parts of the recording that were left out in turn", "On held-out pulses (not used for fitting)"
    return Followed(fit["held_out_fit_percent"], fit.get("held_out_ceiling_percent"), parts if by_parts else pulses)


# ---- curve and dynamics -------------------------------------------------------------------------------------------


def recruitment(document: Mapping[str, Any]) -> dict[str, float | None]:
    """Return threshold (µs), plateau (N·m) and the width at which 95 % of it is reached (µs).

    Where stimulation lowers the torque of the record the curve falls, and its plateau is below zero.
    """
    stored = document["uncertainty"]["figures"]
    return {name: stored[name]["value"] for name in ("threshold_us", "plateau_nm", "saturation_us")}


def dynamics(document: Mapping[str, Any]) -> dict[str, float | None]:
    """Return Tω (s), ζ and delay (s) of 1 / (Tω² s² + 2 ζ Tω s + 1), eq. (31) with damping; None for another order."""
    linear = document["linear"]
    values = {key: linear.get(key) for key in ("time_constant_s", "damping", "delay_s")}
    a = [*linear["a"]]
    while a and a[-1] == 0.0:
        a.pop()
    if values["time_constant_s"] is None and len(a) == 3:  # read off the poles of a second-order denominator
        root = cmath.sqrt(a[1] ** 2 - 4 * a[0] * a[2])
        step_s = linear.get("step_s") or 1.0 / document["sample_rate_hz"]
        poles = [cmath.log((sign * root - a[1]) / (2 * a[0])) / step_s for sign in (1, -1)]
        if speed := abs(poles[0] * poles[1]) ** 0.5:
            values |= {"time_constant_s": 1.0 / speed, "damping": -sum(poles).real / 2 / speed}
    return values


def validity(document: Mapping[str, Any]) -> str | None:
    """Describe the model's range of validity in one sentence; None where it is not stated."""
    known = document.get("valid_for") or {}
    named = []
    if known.get("pulse_width_us"):
        named.append("pulse widths of {:.0f}–{:.0f} µs".format(*known["pulse_width_us"]))
    if known.get("torque_nm"):
        largest = max(map(float, known["torque_nm"]), key=abs)
        named.append(f"torques up to {largest:.1f} N·m" if largest >= 0 else f"torques down to {largest:.1f} N·m")
    if known.get("pulse_rate_hz"):
        named.append("{:.0f}–{:.0f} pulses/s".format(*known["pulse_rate_hz"]))
    return f"Valid for {', '.join(named)}." if named else None


def muscle_figures(document: Mapping[str, Any]) -> dict[str, Figure]:
    """Return threshold, plateau, dynamics, and the main parameter of each effect as `effect.parameter`."""
    stored, read_off = document["uncertainty"]["figures"], dynamics(document)
    figures = {
        name: stored.get(name) or {"value": read_off.get(name), "sd": None, "unit": unit}
        for name, unit in UNITS.items()
    }
    for effect in document.get("effects") or []:
        known = effect.get("parameters") or {}
        for name in [*(name for name in fact_of(effect["id"], "main", ()) if name in known), *known][:1]:
            value = {"unit": "1", **known[name], "form": effect.get("form") or ""}
            figures[f"{effect['id']}.{name}"] = {key: value[key] for key in ("value", "sd", "unit", "form")}
    return figures


def threshold_us(row: Model) -> float | None:
    """Return the threshold of a version's curve, µs; None where it has none."""
    value: float | None = row.fit["figures"]["threshold_us"]["value"]
    return value
