"""MODEL.json: the bytes as they were stored, and what a person reads off it.

Figures and verdict, threshold and plateau, natural period and damping; and the figures that are followed over sessions,
each with its standard deviation.
"""

from __future__ import annotations

import cmath
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stimrig.api.effect_words import fact_of
from stimrig.api.errors import ApiError
from stimrig.identify.yardstick import repetition_sentences

if TYPE_CHECKING:
    from stimrig.api.store.tables import Model

# ---- as it was stored ---------------------------------------------------------------------------------------------


def whole(row: Model) -> bytes:
    """A version's bytes, for the controller and for files. Raises ApiError (500) where they are damaged."""
    if hashlib.sha256(row.document).hexdigest() != row.etag:
        detail = (
            f"{row.id} is no longer what was stored (its checksum differs). Restore the database from a backup, or fit "
            "its recording again."
        )
        raise ApiError(500, "model-damaged", "The stored model is damaged", detail)
    return row.document


def read(row: Model) -> dict[str, Any]:
    """A version's document. Raises ApiError (500) where it is damaged."""
    return json.loads(whole(row))


def text(row: Model) -> str:
    """A version's document as workers are given it. Raises ApiError (500) where it is damaged."""
    return whole(row).decode()


def structure(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the effects of a model, each with its form where it has one: `id:form`."""
    forms = {effect["id"]: effect.get("form") or "" for effect in document.get("effects") or []}
    return {name: f"{name}:{form}".removesuffix(":") for name, form in forms.items()}


def is_plain(document: Mapping[str, Any]) -> bool:
    """Return whether the structure is the plain one: no effects around f(u) and a G of second order."""
    return not structure(document) and "time_constant_s" in document["linear"]


# ---- verdict and fit ----------------------------------------------------------------------------------------------

UNDEFINED = "not defined: the torque is level there"
"""Placeholder for a model that has an error but no best-fit %."""
NO_VERDICT = {"verdict": "unknown", "words": "No verdict was stored with this model: fit it again.", "reasons": []}
FIT = (
    "fit_percent", "ceiling_percent", "held_out_fit_percent", "held_out_ceiling_percent",
    "rms_nm", "held_out_rms_nm", "held_out_by", "noise_sd_nm",
)  # fmt: skip


def repetition(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the repetition statistics of a MODEL.json, with `sentences`; None for unknown ones."""
    statistics = document["fit"].get("repetition") or dict.fromkeys(("found_by", "rms_nm", "explained_percent"))
    return {**statistics, "sentences": repetition_sentences(document["fit"])}


def figures(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the headline figures of a MODEL.json."""
    return {name: document["fit"].get(name) for name in FIT}


def quality(document: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict of identify on a model: `verdict`, `words` (a sentence) and `reasons`; "unknown" without one."""
    stored = document.get("quality") or NO_VERDICT
    return {name: stored[name] for name in NO_VERDICT}


def without_evidence(document: Mapping[str, Any]) -> list[str]:
    """The effects of a model that a person added although the recording did not ask for them."""
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


@dataclass(frozen=True)
class Followed:
    """Return how much of the torque a model explains: the same figure of merit on every page.

    Best fit, and the most that the sensor noise allows on the same pulses, %; None where it is not defined. `where`:
    the pulses it was found on, as the beginning of a sentence.
    """

    percent: float | None
    ceiling_percent: float | None
    where: str
    held_out: bool = True


def followed(fit: Mapping[str, Any]) -> Followed:
    """The figure of a model's `fit`: of pulses not used for fitting where there are any."""
    if fit.get("held_out_fit_percent") is None:
        where = "On the pulses that it was fitted to"
        return Followed(fit.get("fit_percent"), fit.get("ceiling_percent"), where, held_out=False)
    if fit.get("held_out_by") == "cross-validation":
        where = "On parts of the recording that were left out in turn"
    else:
        where = "On held-out pulses (not used for fitting)"
    return Followed(fit["held_out_fit_percent"], fit.get("held_out_ceiling_percent"), where)


# ---- curve and dynamics -------------------------------------------------------------------------------------------


def recruitment(document: Mapping[str, Any]) -> dict[str, float | None]:
    """Threshold (µs), plateau (N·m) and the width at which 95 % of it is reached (µs).

    Where stimulation lowers the torque of the record the curve falls, and its plateau is below zero.
    """
    stored = document["uncertainty"]["figures"]
    return {name: stored[name]["value"] for name in ("threshold_us", "plateau_nm", "saturation_us")}


def dynamics(document: Mapping[str, Any]) -> dict[str, Any]:
    """Tω (s), ζ and delay (s) where the linear part is of second order; its poles (1/s) besides.

    Tω and ζ are those of eq. (31) with damping: 1 / (Tω² s² + 2 ζ Tω s + 1).
    """
    linear = document["linear"]
    values: dict[str, Any] = {key: linear.get(key) for key in ("time_constant_s", "damping", "delay_s")}
    step_s = linear.get("step_s") or 1.0 / document["sample_rate_hz"]
    poles = _poles(linear["a"], step_s)
    values["poles_per_s"] = [[round(pole.real, 4), round(pole.imag, 4)] for pole in poles]
    if values["time_constant_s"] is None and len(poles) == 2 and abs(poles[0] * poles[1]) > 0:
        speed = math.sqrt(abs(poles[0] * poles[1]))
        values["time_constant_s"], values["damping"] = 1.0 / speed, -(poles[0] + poles[1]).real / 2 / speed
    return values


def _poles(a: list[float], step_s: float) -> list[complex]:
    """Continuous poles of a denominator of at most second order, 1/s."""
    while len(a) > 1 and a[-1] == 0.0:
        a = a[:-1]
    if len(a) == 2:
        roots = [complex(-a[1] / a[0])]
    elif len(a) == 3:
        root = cmath.sqrt(a[1] ** 2 - 4 * a[0] * a[2])
        roots = [(-a[1] + root) / (2 * a[0]), (-a[1] - root) / (2 * a[0])]
    else:
        return []
    return [cmath.log(root) / step_s for root in roots if root != 0]


def validity(document: Mapping[str, Any]) -> str | None:
    """Describe the model's range of validity in one sentence; None where it is not stated."""
    known = document.get("valid_for") or {}
    named = []
    if known.get("pulse_width_us"):
        named.append("pulse widths of {:.0f}–{:.0f} µs".format(*known["pulse_width_us"]))
    if known.get("torque_nm"):
        largest = max(known["torque_nm"], key=abs)
        named.append(f"torques up to {largest:.1f} N·m" if largest >= 0 else f"torques down to {largest:.1f} N·m")
    if known.get("pulse_rate_hz"):
        named.append("{:.0f}–{:.0f} pulses/s".format(*known["pulse_rate_hz"]))
    return f"Valid for {', '.join(named)}." if named else None


# ---- followed over sessions ---------------------------------------------------------------------------------------

Figure = dict[str, Any]
"""`value`, `sd` (None where it is not known) and `unit`; of an effect's parameter, the effect's `form` besides."""
UNITS = {"threshold_us": "µs", "plateau_nm": "N·m", "time_constant_s": "s", "damping": "1", "delay_s": "s"}


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
            figure = {"unit": "1", **known[name]}
            figures[f"{effect['id']}.{name}"] = {
                "value": figure["value"],
                "sd": figure["sd"],
                "unit": figure["unit"],
                "form": effect.get("form") or "",
            }
    return figures


def threshold_us(row: Model) -> float | None:
    """The threshold of a version's curve, µs; None where it has none."""
    value: float | None = row.fit["figures"]["threshold_us"]["value"]
    return value
