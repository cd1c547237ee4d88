"""What rigs say, made harmless before it is kept where pages look: right type, right length, no control signs."""

from __future__ import annotations

import math
import re
from datetime import date, datetime, timedelta
from typing import Any

CODE = re.compile(r"[A-Za-z0-9_-]{1,32}")
EFFECT = re.compile(r"[a-z0-9_]{1,64}")
FIGURE = re.compile(r"threshold_us|plateau_nm|time_constant_s|damping|delay_s|[a-z0-9_]{1,64}\.[a-z0-9_]{1,64}")
LABEL = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?Z")
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069\ufeff]")
MOST_EFFECTS, MOST_FIGURES = 40, 60
NUMBERS = (
    "fit_percent", "ceiling_percent", "held_out_fit_percent", "held_out_ceiling_percent", "rms_nm", "held_out_rms_nm",
    "noise_sd_nm",
)  # fmt: skip


def text(value: Any, most: int = 200) -> str | None:
    if not isinstance(value, str):
        return None
    return CONTROL.sub(" ", value.encode(errors="replace").decode())[:most]


def code(value: Any) -> str | None:
    return value if isinstance(value, str) and CODE.fullmatch(value) else None


def label(value: Any, otherwise: str) -> str:
    """A time in UTC as we write it, else another."""
    if isinstance(value, str) and LABEL.fullmatch(value):
        try:
            datetime.fromisoformat(value.replace("Z", "+00:00"))
        except ValueError:
            return otherwise
        return value if "1970-01-03" < value < "9999" else otherwise  # days around it are days in any time zone
    return otherwise


def number(value: Any) -> float | None:
    """A finite number that a chart can show, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) and abs(found) < 1e15 else None


def current_ma(plan: Any) -> float | None:
    """The current of a test's pulses."""
    profile = plan.get("profile") if isinstance(plan, dict) else None
    return number(profile.get("current_ma")) if isinstance(profile, dict) else None


def effects(value: Any) -> list[str]:
    listed = value[: 10 * MOST_EFFECTS] if isinstance(value, list) else []
    named = [one for one in listed if isinstance(one, str) and EFFECT.fullmatch(one)]
    return list(dict.fromkeys(named))[:MOST_EFFECTS]


def fit(value: Any) -> dict[str, Any]:
    """The figures and the verdict of a model's `fit`."""
    given = value if isinstance(value, dict) else {}
    found: dict[str, Any] = {name: number(given.get(name)) for name in NUMBERS}
    for name, most in (("held_out_by", 40), ("verdict", 40), ("words", 400)):
        found[name] = text(given.get(name), most)
    listed = given.get("figures")
    figures = list(listed.items())[:MOST_FIGURES] if isinstance(listed, dict) else []
    found["figures"] = {
        name: {
            "value": number(one.get("value")),
            "sd": number(one.get("sd")),
            "unit": text(one.get("unit"), 20) or "1",
            **({"form": form} if (form := text(one.get("form"), 40)) else {}),
        }
        for name, one in figures
        if FIGURE.fullmatch(name) and isinstance(one, dict)
    }
    return found


def days_later(given: str, days: int) -> str:
    return (date.fromisoformat(given) + timedelta(days=days)).isoformat()


def a_day(value: str) -> str | None:
    """A day as 2026-11-23, or None."""
    try:
        return date.fromisoformat(value).isoformat() if len(value) == 10 else None
    except ValueError:
        return None
