"""Display of results: one line, a summary of about ten lines, and a table in notebooks."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

from stimrig.identify.conclusion import PROBABLE, VERY_PROBABLE, conclude
from stimrig.identify.errors import BadRequest

Plotter = Callable[[Any, Any], Any]
"""`plotter(result, record) -> figure`: draws a model, comparison, diagnosis or improvement. The record may be None."""
_plotters: list[Plotter] = []
"""At most one; `identify` itself draws nothing and imports no plotting library."""

NONE = "–"
LONGEST = 300
"""Largest number of characters of a line."""


@dataclass(frozen=True)
class Sheet:
    """A title and rows of a label and a text."""

    title: str  # what it is, with the most important values, in one line
    rows: tuple[tuple[str, str], ...]  # one line each

    def text(self) -> str:
        """Title and rows, with aligned labels."""
        rows = [(one_line(label), one_line(words)) for label, words in self.rows]
        width = max((len(label) for label, _ in rows), default=0)
        return "\n".join([one_line(self.title), *[f"{label.ljust(width)}  {words}".rstrip() for label, words in rows]])

    def html(self) -> str:
        """An HTML table without style sheet, script or other file; all text is escaped."""
        style = "text-align:left;vertical-align:top"
        rows = "".join(
            f'<tr><th scope="row" style="{style}">{_escaped(label)}</th><td style="{style}">{_escaped(words)}</td></tr>'
            for label, words in self.rows
        )
        caption = f'<caption style="text-align:left;font-weight:bold">{_escaped(self.title)}</caption>'
        return f"<table>{caption}<tbody>{rows}</tbody></table>"


def register_plotter(plotter: Plotter) -> None:
    """Set the function that draws results, in place of an earlier one (see `Plotter`)."""
    _plotters[:] = [plotter]


class Summarised:
    """Base class of results that are printed and shown in notebooks."""

    def _sheet(self) -> Sheet:
        raise NotImplementedError

    def summary(self) -> str:
        """A summary of about ten lines."""
        return self._sheet().text()

    def __str__(self) -> str:
        return self.summary()

    def __repr__(self) -> str:
        return f"<{one_line(self._sheet().title)}>"

    def _repr_html_(self) -> str:
        return self._sheet().html()

    def plot(self, record: Any = None) -> Any:
        """Draw the result with the registered plotter.

        Parameters
        ----------
        record : Record or None
            The measurement to draw beside it; a model needs one.

        Returns
        -------
        figure
            Whatever the plotter returns.

        Raises
        ------
        BadRequest
            No plotter is registered, or it cannot draw this result.
        """
        if not _plotters:
            raise BadRequest("no plotter is registered", place="plot", fix="Import stimrig first; it registers one.")
        return _plotters[0](self, record)


def one_line(text: str) -> str:
    """A text without line breaks and unprintable characters, shortened if it is very long."""
    printable = "".join(sign if sign.isprintable() else " " for sign in str(text))
    words = " ".join(printable.split())
    return words if len(words) <= LONGEST else f"{words[: LONGEST - 1]}…"


def _escaped(text: str) -> str:
    return html.escape(one_line(text))


def quantity(value: Any, unit: str) -> str:
    """A number with its unit, with three digits (per cent: one decimal); a dash if there is no number.

    The unit "1" of a pure number is left out.
    """
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        return NONE
    value = float(value)
    digits = f"{value:.1f}" if unit == "%" else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return digits if unit in ("", "1") else f"{digits} {unit}"


def estimate(value: Any, sd: Any, unit: str) -> str:
    """An estimate with its standard deviation, such as "0.53 ± 0.01 s"; without the ± if there is no deviation."""
    spread = "" if sd is None or quantity(sd, "") == NONE else f" ± {sd:.2g}"
    return f"{quantity(value, '')}{spread}{'' if unit in ('', '1') else f' {unit}'}"


def parameter_words(parameters: Mapping[str, Any], max_shown: int) -> list[str]:
    """The first parameters of an effect, each a number alone or with `sd`, `unit` and `direction`."""
    words = []
    for name, entry in list(parameters.items())[:max_shown]:
        entry = entry if isinstance(entry, dict) else {"value": entry}
        value = estimate(entry.get("value"), entry.get("sd"), str(entry.get("unit") or "1"))
        words.append(f"{name} {value} {entry.get('direction') or ''}".rstrip())
    return words


def fit_words(figures: Mapping[str, Any], prefix: str = "") -> str:
    """Fit of a model, the best fit that the noise allows, and the error."""
    allowed = figures.get(f"{prefix}ceiling_percent")
    ceiling = "" if allowed is None else f" (the noise allows {quantity(allowed, '%')})"
    fit, error = quantity(figures.get(f"{prefix}fit_percent"), "%"), torque(figures, f"{prefix}rms_nm")
    return f"fit {fit}{ceiling}, error {error}"


def both_words(figures: Mapping[str, Any]) -> str:
    """The same for fitted rows and held-out pulses, in one line."""
    held_out = f"fit {quantity(figures.get('held_out_fit_percent'), '%')}, error {torque(figures, 'held_out_rms_nm')}"
    return f"{fit_words(figures)}; {held_out_label(figures)} {held_out}"


def held_out_label(figures: Mapping[str, Any]) -> str:
    """Name of the held-out errors: from `validate`, or from blocks that were left out of the fit in turn."""
    return "cross-validated" if figures.get("held_out_by") == "cross-validation" else "held out"


def probability_words(value: float) -> str:
    """A probability in words."""
    return "very probably" if value > VERY_PROBABLE else "probably" if value > PROBABLE else "possibly"


def parameters_words(count: int) -> str:
    """How many parameters a change adds."""
    return "1 parameter" if count == 1 else f"{count} parameters"


def error_change(row: Mapping[str, Any]) -> str:
    """Change of the left-out error in a row of a diagnosis's table, with its standard error; empty if not computed."""
    if row["change_percent"] is None:
        return ""
    spread = "" if row["sd_percent"] is None else f" ± {row['sd_percent']:.0f}"
    return f"{row['change_percent']:+.0f}{spread} %"


def stretch_words(row: Mapping[str, Any]) -> list[str]:
    """Where in the record a row of the table improves the model most."""
    return [f"seen most from {begin:.0f} to {end:.0f} s" for begin, end in row["seconds"]]


def change_words(row: Mapping[str, Any]) -> str:
    """A row of a diagnosis's table in one line: change of the left-out error, parameters, probability, status."""
    words = [] if row["effect"] else ["no change: nothing is missing"]
    words += [f"error {change}"] if (change := error_change(row)) else []
    words += [parameters_words(row["parameters"])] * bool(row["parameters"])
    words += [] if row["probability"] is None else [f"probability {probability(row['probability'])}"]
    words += stretch_words(row)
    return "; ".join(words + [": ".join(filter(None, (row["status"], row["reason"])))] * bool(row["status"]))


def torque(figures: Mapping[str, Any], key: str) -> str:
    """A torque from a dict, with its unit."""
    return quantity(figures.get(key), "N·m")


def certainty(diagnosis: Mapping[str, Any]) -> str:
    """The probability of a verdict, behind its title; empty where none is sure or effects have their own."""
    missing = diagnosis.get("missing") or []
    doubted = missing and diagnosis["verdict"] == "unexplained_structure"
    if doubted or len(missing) > 1 or conclude(diagnosis).kind == "unsure":
        return ""
    return f" (probability {probability(diagnosis['probability'])})"


def probability(value: float) -> str:
    """A probability in per cent; 100 % only if it is exactly 1."""
    return f"{min(round(100 * value), 99)} %" if value < 1.0 else "100 %"
