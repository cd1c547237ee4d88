"""Data of a figure: panels over one x axis with curves, bands, shades, rules and labels, and colours by role.

`interactive.py` turns a figure into plotly's form, `drawing.py` into SVG, PDF or PNG.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stimrig.api.clinical_words import segment_words

SHEET = Path(__file__).parents[1] / "web" / "pages" / "static" / "page.css"


def _read_light() -> dict[str, str]:
    """Read the light colours of `page.css` by role; a role that refers to another one has that one's colour."""
    sheet = SHEET.read_text("utf-8")
    values = re.findall(r"--([\w-]+): ([^;]+);", sheet[: sheet.index("\n}")])
    colours = {name: value.removeprefix("light-dark(").partition(", ")[0] for name, value in values}
    return {name: colours.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in colours.items()}


LIGHT = _read_light()


def variable(role: str) -> str:
    """Return the CSS variable of a colour's role."""
    return f"var(--{role})"


@dataclass(frozen=True)
class Value:
    """Format of a value under the pointer: its unit with the space before it, decimals, and a sign where it matters."""

    unit: str
    digits: int
    signed: bool = False


TORQUE, RESIDUAL, WIDTH = Value(" N·m", 2), Value(" N·m", 3, signed=True), Value(" µs", 0)
ERROR, SHARE, FACTOR = Value(" N·m", 3), Value("", 3), Value("", 2)
AT_TIME, AT_ANGLE = Value(" s", 2), Value("°", 0)


@dataclass(frozen=True)
class Axis:
    """An axis: quantity with unit; `share` is the panel's height relative to the others, `ticks` replace numbers."""

    label: str
    value: Value | None = None
    limits: tuple[float, float] | None = None
    ticks: Sequence[tuple[float, str]] = ()
    from_zero: bool = False
    share: float = 1.0


@dataclass(frozen=True)
class Curve:
    """Points joined by a line; None breaks it. Without `width` only markers are drawn.

    A `cap` that is not `butt` makes dots of lines without length. `notes` stand behind the values under the pointer,
    one for each point.
    """

    x: Sequence[float]
    y: Sequence[float | None]
    label: str
    colour: str
    width: float = 1.6
    dash: str = "solid"
    step: bool = False
    panel: int = 0
    marker: str = ""
    size: float = 8
    every: int = 1
    hollow: bool = False
    cap: str = "butt"
    value: Value | None = None
    notes: Sequence[str] = ()
    listed: bool = True


@dataclass(frozen=True)
class Band:
    """The area between two curves."""

    x: Sequence[float]
    lower: Sequence[float]
    upper: Sequence[float]
    label: str = "95 % band"
    colour: str = "model-band"
    panel: int = 0
    listed: bool = True


@dataclass(frozen=True)
class Shade:
    """A stretch of x over all panels; with `low` and `high` a range of one panel's values over all x."""

    colour: str
    start: float = 0.0
    end: float = 0.0
    low: float | None = None
    high: float | None = None
    panel: int = 0


@dataclass(frozen=True)
class Rule:
    """A dashed line at a value of the first panel, or at a place on the x axis; with its text at one end."""

    at: float
    text: str = ""
    colour: str = "limit"
    vertical: bool = False
    right: bool = False


@dataclass(frozen=True)
class Label:
    """A name above the panels; with a `badge`, the colour of its ground, a number within them."""

    x: float
    text: str
    badge: str = ""


@dataclass(frozen=True)
class Figure:
    """A figure; `height` in px."""

    x: Axis
    panels: tuple[Axis, ...]
    curves: tuple[Curve, ...]
    bands: tuple[Band, ...] = ()
    shades: tuple[Shade, ...] = ()
    rules: tuple[Rule, ...] = ()
    labels: tuple[Label, ...] = ()
    height: float = 340

    def entries(self) -> list[Band | Curve]:
        """Return what the legend names; nothing where one line needs no name."""
        listed = [part for part in (*self.bands, *self.curves) if part.listed and part.label]
        return listed if len(listed) > 1 else []


# ---- what MODEL.json and recordings give ---------------------------------------------------------------------------


def band_of(document: dict[str, Any], curve: str, along: str, colour: str = "model-band") -> Band | None:
    """Return a curve's band in MODEL.json; None where the method gives none."""
    known = ((document.get("uncertainty") or {}).get("bands") or {}).get(curve)
    return Band(known[along], known["whole_lower"], known["whole_upper"], colour=colour) if known else None


def half_widths(band: Band | None, x: Sequence[float]) -> list[str]:
    """Return the half width of a band at each x, as text."""
    import numpy as np

    if band is None:
        return []
    halves = (np.asarray(band.upper) - np.asarray(band.lower)) / 2
    return [f"± {half:.2f}" for half in np.interp(x, band.x, halves)]


def segment_names(time_s: Sequence[float], segments: Sequence[dict[str, Any]]) -> list[str]:
    """Return the name of the segment at each time."""
    names, number = [], 0
    for moment_s in time_s:
        while number < len(segments) - 1 and moment_s >= segments[number + 1]["start_s"]:
            number += 1
        names.append(f"· {segment_words(segments[number]['name'])}" if segments else "")
    return names
