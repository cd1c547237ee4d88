"""The figures of a model that are followed over sessions, each with its standard deviation, read off its MODEL.json."""

from __future__ import annotations

from typing import Any

from stimrig.api.models import stored, summary
from stimrig.api.store.tables import Model

Figure = dict[str, Any]
"""`value`, `sd` (None where it is not known) and `unit`; of an effect's parameter, the effect's `form` besides."""
MUSCLE = ("threshold_us", "plateau_nm", "time_constant_s", "damping", "delay_s")
UNITS = {"threshold_us": "µs", "plateau_nm": "N·m", "time_constant_s": "s", "damping": "1", "delay_s": "s"}
MAIN = {
    "asymmetric_relaxation": ("ratio", "fall_s"),
    "passive_torque": ("stiffness_nm_per_rad",),
    "recruitment_hysteresis": ("half_width_us", "share"),
    "tremor": ("frequency_hz",),
    "voluntary_effort": ("height_0_nm", "height_1_nm"),
}
"""The parameters that stand for an effect, first choice first; of others the first one that they name."""


def of(document: dict[str, Any]) -> dict[str, Figure]:
    """Threshold, plateau, time constant, damping, delay, and each effect's main parameter as `effect.parameter`.

    Models from before the figures were stored have their values, without standard deviations.
    """
    stored = (document.get("uncertainty") or {}).get("figures") or {}
    values = {**summary.recruitment(document), **summary.dynamics(document)}
    found = {name: stored.get(name) or plain(values.get(name), UNITS[name]) for name in MUSCLE}
    for effect in document.get("effects") or []:
        known = effect.get("parameters") or {}
        wanted = [name for name in MAIN.get(effect["id"], ()) if name in known] or list(known)[:1]
        for name in wanted[:1]:
            given = known[name] if isinstance(known[name], dict) else {"value": known[name]}
            figure = plain(given.get("value"), given.get("unit") or "1", given.get("sd"))
            found[f"{effect['id']}.{name}"] = {**figure, "form": effect.get("form") or ""}
    return found


def threshold_us(row: Model) -> float | None:
    """The threshold of a version's curve, µs; None where it has none. Raises ApiError (500) where it is damaged."""
    figures = row.fit.get("figures") or of(stored.read(row))
    value: float | None = figures["threshold_us"]["value"]
    return value


def structure(effects: list[str], figures: dict[str, Figure]) -> tuple[str, ...]:
    """Each effect as `id:form`, `id` where its form is not known: a parameter means something else in another form."""
    forms = {name.partition(".")[0]: figure["form"] for name, figure in figures.items() if figure.get("form")}
    return tuple(sorted(f"{effect}:{forms.get(effect, '')}".removesuffix(":") for effect in effects))


def plain(value: float | None, unit: str, sd: float | None = None) -> Figure:
    """A figure."""
    return {"value": value, "sd": sd, "unit": unit}
