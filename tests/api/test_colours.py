"""Every text can be read in light and in dark: contrast ratio and relative luminance as in WCAG 2.2."""

from __future__ import annotations

import re

import pytest

from stimrig.api.web.pages.environment import HERE

STATIC = HERE / "static"
LUMINANCE = (0.2126, 0.7152, 0.0722)


def modes() -> dict[str, dict[str, str]]:
    """The colours of the style sheet's first `:root`, in light and in dark."""
    body = (STATIC / "page.css").read_text("utf-8").partition(":root {")[2].partition("\n}")[0]
    pairs = {
        name: re.fullmatch(r"light-dark\((\S+), (\S+)\)", value)
        for name, value in re.findall(r"--([\w-]+): ([^;]+);", body)
    }
    same = dict(re.findall(r"--([\w-]+): (#[0-9a-f]+);", body))
    return {
        mode: same | {name: pair[number] for name, pair in pairs.items() if pair}
        for number, mode in enumerate(("light", "dark"), start=1)
    }


def linear(colour: str) -> tuple[float, float, float]:
    """Linear RGB of `#rgb` or `#rrggbb`."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return red, green, blue


def contrast(one: str, other: str) -> float:
    """WCAG's contrast ratio."""
    low, high = sorted(sum(a * b for a, b in zip(LUMINANCE, linear(colour), strict=True)) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


MODES = modes()
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
    *((f"series-{k}", "chart") for k in range(1, 7)),
    *((role, "chart") for role in ("measured", "model", "residual", "width", "rising", "falling", "limit", "worst")),
]  # fmt: skip
"""Parts whose shape has to be seen (WCAG 1.4.11)."""


@pytest.mark.parametrize("mode", MODES)
def test_text_stands_out_from_what_it_stands_on(mode: str) -> None:
    colours = MODES[mode]
    faint = {pair: round(found, 2) for pair in TEXT if (found := contrast(*(colours[name] for name in pair))) < 4.5}
    faint |= {pair: round(found, 2) for pair in SEEN if (found := contrast(*(colours[name] for name in pair))) < 3.0}
    assert faint == {}


def test_the_measure_is_the_published_one() -> None:
    assert contrast("#000", "#fff") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)
