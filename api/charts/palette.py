"""Colours of charts by what a line means. A page gives each its value, light or dark; here are the light ones.

A figure holds `var(--name)`: a page's stills take the value from the style sheet, its scripts look it up when they
draw, and what has no style sheet (a notebook, a printed sheet) takes `LIGHT`. `tests/api/test_colours.py` computes that
everybody tells them apart.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

SHEET = Path(__file__).parents[1] / "web" / "pages" / "static" / "page.css"
NAMED = re.compile(r"var\(--([\w-]+)\)")
PAINTED = re.compile(r'(fill|stroke)="var\(--([\w-]+)\)"')


def _light() -> dict[str, str]:
    """The values that `page.css` gives to its names; a name for another colour has that one's."""
    sheet = SHEET.read_text("utf-8")
    found = dict(re.findall(r"--([\w-]+): ([^;]+);", sheet[: sheet.index("\n}")]))
    return {name: found.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in found.items()}


LIGHT = _light()


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
