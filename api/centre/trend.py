"""Models of a participant's sessions as the trend's charts take them (`api.charts.trend_charts`)."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from api.models import changes
from api.models.followed import followed


def documents(code: str, stood: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One for each session with a model, oldest first."""
    return [_document(code, **one) for one in stood]


def _document(code: str, session: Any, model: Any, rig: str) -> dict[str, Any]:
    told = model.fit.get("figures") or {}
    figures = {name: {**one, "uncertainty": _uncertainty(name, one)} for name, one in told.items()}
    found = followed(model.fit)
    figures["follows_percent"] = {**_plain(found.percent, "%"), "where": found.where}
    figures["noise_sd_nm"] = _plain(model.fit.get("noise_sd_nm"), "N·m")
    figures["current_ma"] = _plain(session.current_ma, "mA")
    here = f"{session.day}~{session.rig_id}"
    return {
        "at_utc": session.at_utc, "model_id": model.id, "approved": session.approved_by is not None,
        "approved_by": session.approved_by, "figures": _without_empty(figures), "rig": rig,
        "notes": [], "href": f"/participants/{quote(code)}?before={session.day}~{session.rig_id + 1}#s-{here}",
    }  # fmt: skip


def _uncertainty(name: str, figure: dict[str, Any]) -> float | None:
    if (figure.get("sd") or 0.0) < 0.0:
        return None
    return changes.uncertainty(name, figure)


def _plain(value: float | None, unit: str) -> dict[str, Any]:
    return {"value": value, "sd": None, "uncertainty": None, "unit": unit}


def _without_empty(figures: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Without what is not known, but for the current, which the charts ask for."""
    return {name: one for name, one in figures.items() if one["value"] is not None or name == "current_ma"}
