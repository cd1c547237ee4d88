"""Colours of charts by what a line means. A page gives each its value, light or dark; here stand the light ones.

A figure holds `var(--name)`: a page's stills take the value from the style sheet, its scripts look it up when they
draw, and what has no style sheet (a notebook, a printed sheet) takes `LIGHT`. `tests/api/test_colours.py` compares
these with `page.css`, and computes that everybody tells them apart.
"""

from __future__ import annotations

import re
from typing import Any

LIGHT = {
    "ink": "#1b2733",
    "dim": "#52606d",
    "line": "#d9dfe4",
    "accent": "#0b6b75",
    "card": "#fff",
    "chart": "#fff",
    "grid": "#e6eaee",
    "zero": "#c3ccd4",
    "mark": "#52606d",
    "measured": "#8895a0",
    "model": "#135f68",
    "model-band": "rgba(19,95,104,.16)",
    "noise-band": "rgba(19,95,104,.13)",
    "residual": "#1a2532",
    "width": "#b2650d",
    "width-band": "rgba(178,101,13,.16)",
    "rising": "#678dbf",
    "falling": "#ca420b",
    "plan": "#c3ccd4",
    "limit": "#b3121d",
    "cursor": "#84909b",
    "held-out": "rgba(178,101,13,.08)",
    "segment": "rgba(27,39,51,.035)",
    "worst": "#b3121d",
    "worst-band": "rgba(179,18,29,.1)",
    "on-worst": "#fff",
    "series-band": "rgba(82,96,109,.14)",
    "series-1": "#2533d8",
    "series-2": "#bf752d",
    "series-3": "#38308e",
    "series-4": "#c32c78",
    "series-5": "#4e6500",
    "series-6": "#062234",
}
NAMED = re.compile(r"var\(--([\w-]+)\)")
PAINTED = re.compile(r'(fill|stroke)="var\(--([\w-]+)\)"')


def role(name: str) -> str:
    """A colour by its role, for a page."""
    assert name in LIGHT, name
    return f"var(--{name})"


def in_light(part: Any) -> Any:
    """A figure with the light colours in it."""
    if isinstance(part, dict):
        return {key: in_light(value) for key, value in part.items()}
    if isinstance(part, list):
        return [in_light(value) for value in part] if part and not isinstance(part[0], float | int) else part
    named = NAMED.fullmatch(part) if isinstance(part, str) else None
    return LIGHT[named[1]] if named else part


def painted_light(picture: str) -> str:
    """A still with the light colours in it; its words are left alone."""
    return PAINTED.sub(lambda found: f'{found[1]}="{LIGHT[found[2]]}"', picture)
