"""Every text can be read in light and in dark: contrast ratio and relative luminance as in WCAG 2.2."""

from __future__ import annotations

import re

import pytest

from stimrig.api.charts.figure import SHEET

LUMINANCE = (0.2126, 0.7152, 0.0722)
SURFACES = ("card", "paper", "soft", "chart")
TEXT = [
    *((ink, surface) for surface in SURFACES for ink in ("ink", "dim", "accent")),
    *((ink, kind + "-bg") for kind in ("good", "warn", "bad") for ink in (kind, "ink", "dim")),
    ("on-strong", "stimulate"), ("on-strong", "stop"),
    ("on-primary", "accent"), ("bad", "card"), ("mark", "chart"), ("on-worst", "worst"), ("card", "good"),
]  # fmt: skip
"""Ink and what it stands on."""
SEEN = [
    *((part, surface) for part in ("edge", "stop", "stimulate", "accent") for surface in ("card", "paper")),
    *((part, "card") for part in ("good", "warn", "cursor")),
    *((f"series-{k}", "chart") for k in (1, 2, 3, 4, 6)),
    *((role, "chart") for role in ("measured", "model", "residual", "width", "limit", "worst")),
]  # fmt: skip
"""Parts whose shape has to be seen (WCAG 1.4.11)."""


def contrast(*colours: str) -> float:
    """WCAG's contrast ratio of two colours, `#rgb` or `#rrggbb`."""
    luminances = []
    for colour in colours:
        digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
        parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
        linear = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
        luminances.append(sum(weight * part for weight, part in zip(LUMINANCE, linear, strict=True)))
    return (max(luminances) + 0.05) / (min(luminances) + 0.05)


@pytest.mark.parametrize("mode", [0, 1], ids=["light", "dark"])
def test_text_stands_out_from_what_it_stands_on(mode: int) -> None:
    body = SHEET.read_text("utf-8").partition(":root {")[2].partition("\n}")[0]
    pairs = re.findall(r"--([\w-]+): (?:light-dark\((\S+), (\S+)\)|(\S+));", body)
    colours = {name: both or (light, dark)[mode] for name, light, dark, both in pairs}
    colours = {name: colours.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in colours.items()}
    assert contrast("#767676", "#fff") == pytest.approx(4.54, abs=0.01), "the measure is the published one"
    for least, wanted in ((4.5, TEXT), (3.0, SEEN)):
        found = {pair: round(contrast(*(colours[name] for name in pair)), 2) for pair in wanted}
        assert {pair: ratio for pair, ratio in found.items() if ratio < least} == {}
