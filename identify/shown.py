"""How a result shows itself: one line, a sheet of about ten lines, the same sheet as a table for notebooks."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

NONE = "–"
SURE, LIKELY = 0.9, 0.6
"""Probabilities above which a thing is very probably, and probably, so."""
LONGEST = 300
"""Characters of a line at most."""


@dataclass(frozen=True)
class Sheet:
    """A title and rows of a label and a text.

    Parameters
    ----------
    title : str
        What it is, and the figures that count, in one line.
    rows : tuple of (str, str)
        Each is a line.
    """

    title: str
    rows: tuple[tuple[str, str], ...]

    def line(self) -> str:
        """The title alone."""
        return one_line(self.title)

    def text(self) -> str:
        """Title and rows, labels aligned."""
        rows = [(one_line(label), one_line(words)) for label, words in self.rows]
        width = max((len(label) for label, _ in rows), default=0)
        return "\n".join([self.line(), *[f"{label.ljust(width)}  {words}".rstrip() for label, words in rows]])

    def html(self) -> str:
        """A table that needs no style sheet, no script and no other file; every word is escaped."""
        style = "text-align:left;vertical-align:top"
        rows = "".join(
            f'<tr><th scope="row" style="{style}">{_escaped(label)}</th><td style="{style}">{_escaped(words)}</td></tr>'
            for label, words in self.rows
        )
        caption = f'<caption style="text-align:left;font-weight:bold">{_escaped(self.title)}</caption>'
        return f"<table>{caption}<tbody>{rows}</tbody></table>"


class Shown:
    """Base of what shows itself."""

    def _sheet(self) -> Sheet:
        raise NotImplementedError

    def summary(self) -> str:
        """About ten lines for people."""
        return self._sheet().text()

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return f"<{self._sheet().line()}>"

    def _repr_html_(self) -> str:
        return self._sheet().html()


def one_line(text: str) -> str:
    """A text without line breaks and other signs that no one sees, cut where it is very long."""
    seen = "".join(sign if sign.isprintable() else " " for sign in str(text))
    words = " ".join(seen.split())
    return words if len(words) <= LONGEST else f"{words[: LONGEST - 1]}…"


def _escaped(text: str) -> str:
    return html.escape(one_line(text))


def quantity(value: Any, unit: str) -> str:
    """A number with its unit, three digits (percentages: one decimal); a dash where there is none.

    The unit "1" is left out: a pure number has none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not math.isfinite(value):
        return NONE
    digits = f"{value:.1f}" if unit == "%" else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return digits if unit in ("", "1") else f"{digits} {unit}"


def fit_words(figures: Mapping[str, Any], prefix: str = "") -> str:
    """How well a model fits: percentages, what the noise allows, and the error."""
    allowed = figures.get(f"{prefix}ceiling_percent")
    most = "" if allowed is None else f" (the noise allows {quantity(allowed, '%')})"
    return f"fit {quantity(figures.get(f'{prefix}fit_percent'), '%')}{most}, rms {torque(figures, f'{prefix}rms_nm')}"


def both_words(figures: Mapping[str, Any]) -> str:
    """The same on fitted rows and on rows held out, in one line."""
    held_out = f"{quantity(figures.get('held_out_fit_percent'), '%')}, rms {torque(figures, 'held_out_rms_nm')}"
    return f"{fit_words(figures)}; {held_out_label(figures)} {held_out}"


def held_out_label(figures: Mapping[str, Any]) -> str:
    """What the held-out figures are: those of `validate`; without it, of blocks left out of the fit in turn."""
    return "cross-validated" if figures.get("held_out_by") == "cross-validation" else "held out"


def sure(value: float) -> str:
    """A probability in a word."""
    return "very probably" if value > SURE else "probably" if value > LIKELY else "possibly"


def torque(figures: Mapping[str, Any], key: str) -> str:
    """A torque of a table, N·m."""
    return quantity(figures.get(key), "N·m")


def probability(value: float) -> str:
    """A probability in per cent; what is nearly sure stays below 100."""
    return f"{min(round(100 * value), 99)} %" if value < 1.0 else "100 %"
