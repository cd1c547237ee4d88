"""Every text can be read in light and in dark, and the charts' colours are told apart by everybody.

Contrast: WCAG 2.2, definitions of contrast ratio and relative luminance. Dichromacy: Machado, Oliveira and Fernandes,
"A physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15(6), 2009, table 1, severity 1.0,
applied to linear RGB. Difference: CIEDE2000 as in Sharma, Wu and Dalal, Color Res. Appl. 30(1), 2005.
"""

from __future__ import annotations

import re
from itertools import combinations
from math import atan2, cos, degrees, exp, hypot, radians, sin, sqrt

import pytest

from stimrig.api.web.pages.environment import HERE

STATIC = HERE / "static"
Rgb = tuple[float, float, float]
LUMINANCE = (0.2126, 0.7152, 0.0722)
VISION: dict[str, tuple[Rgb, Rgb, Rgb]] = {
    "normal": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "protanopia": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deuteranopia": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    "tritanopia": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
    "grey": (LUMINANCE, LUMINANCE, LUMINANCE),
}
TO_XYZ = ((0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041))
WHITE = (0.95047, 1.0, 1.08883)


def variables(sheet: str) -> dict[str, str]:
    """Names and values of a style sheet's first `:root`; one that points to another has that one's value."""
    body = re.search(r":root \{(.*?)\n\}", (STATIC / sheet).read_text("utf-8"), re.DOTALL)
    assert body is not None
    found = dict(re.findall(r"--([\w-]+): ([^;]+);", body[1]))
    return {name: found.get(value[6:-1], value) if value.startswith("var(") else value for name, value in found.items()}


def modes() -> dict[str, dict[str, str]]:
    """Both sets; the dark one in full."""
    light = variables("page.css")
    dark = {**light, **variables("dark.css")}
    return {"light": light, "dark": {**dark, "torque": dark["model"]}}


def linear(colour: str) -> Rgb:
    """Linear RGB of `#rgb` or `#rrggbb`."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return red, green, blue


def contrast(one: str, other: str) -> float:
    """WCAG's contrast ratio."""
    low, high = sorted(times((LUMINANCE,) * 3, linear(colour))[0] for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def times(matrix: tuple[Rgb, Rgb, Rgb], vector: Rgb) -> Rgb:
    """Matrix times vector."""
    red, green, blue = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in matrix)
    return red, green, blue


def lab(colour: str, vision: str) -> Rgb:
    """CIELAB of a colour as it is seen."""
    red, green, blue = (min(1.0, max(0.0, part)) for part in times(VISION[vision], linear(colour)))
    ratios = [part / white for part, white in zip(times(TO_XYZ, (red, green, blue)), WHITE, strict=True)]
    x, y, z = (t ** (1 / 3) if t > 216 / 24389 else (24389 / 27 * t + 16) / 116 for t in ratios)
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def difference(one: Rgb, other: Rgb) -> float:
    """CIEDE2000 of two CIELAB colours."""
    mean = (hypot(*one[1:]) + hypot(*other[1:])) / 2
    stretch = 1.5 - 0.5 * sqrt(mean**7 / (mean**7 + 25.0**7))
    (l1, a1, b1), (l2, a2, b2) = ((light, stretch * a, b) for light, a, b in (one, other))
    c1, c2, h1, h2 = hypot(a1, b1), hypot(a2, b2), degrees(atan2(b1, a1)) % 360, degrees(atan2(b2, a2)) % 360
    grey = c1 * c2 < 1e-9
    turn = 0.0 if grey else (h2 - h1 + 180) % 360 - 180
    hue = h1 + h2 if grey else (h1 + turn / 2) % 360
    light, chroma, dh = (l1 + l2) / 2, (c1 + c2) / 2, 2 * sqrt(c1 * c2) * sin(radians(turn / 2))
    waves = ((-0.17, 1, -30), (0.24, 2, 0), (0.32, 3, 6), (-0.20, 4, -63))
    t = 1 + sum(part * cos(radians(k * hue + shift)) for part, k, shift in waves)
    s_l = 1 + 0.015 * (light - 50) ** 2 / sqrt(20 + (light - 50) ** 2)
    s_c, s_h = 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    turned = -2 * sqrt(chroma**7 / (chroma**7 + 25.0**7)) * sin(radians(60 * exp(-(((hue - 275) / 25) ** 2))))
    dl, dc = (l2 - l1) / s_l, (c2 - c1) / s_c
    return sqrt(dl**2 + dc**2 + (dh / s_h) ** 2 + turned * dc * dh / s_h)


MODES = modes()
SURFACES = ("card", "paper", "soft", "chosen", "chart")
TEXT = [
    *((ink, surface) for surface in SURFACES for ink in ("ink", "dim", "accent", "accent-dark")),
    *((ink, kind + "-bg") for kind in ("good", "warn", "bad") for ink in (kind, kind + "-ink", "ink", "dim")),
    *((f"on-{name}", name) for name in ("primary", "stimulate", "stop", "tag", "running", "unknown", "emulated")),
    *((f"on-{name}", f"{name}-hover") for name in ("primary", "stimulate", "stop")),
    ("ink", "field"), ("bad", "card"), ("mark", "chart"), ("on-worst", "worst"), ("card", "good"),
]  # fmt: skip
"""Ink and what it stands on."""
SEEN = [
    *((part, surface) for part in ("edge", "focus", "stop", "stimulate", "primary") for surface in ("card", "paper")),
    *((lamp, "card") for lamp in ("lamp-good", "lamp-warn", "lamp-off", "running", "unknown")), ("edge", "field"),
    *((f"series-{k}", "chart") for k in range(1, 7)),
    *((role, "chart") for role in ("measured", "model", "residual", "width", "rising", "falling", "limit", "worst")),
]  # fmt: skip
"""Parts whose shape has to be seen (WCAG 1.4.11)."""
CHARTS = {
    "measurement": ("measured", "model", "residual", "width"),
    "recruitment": ("model", "rising", "falling"),
    "live": ("torque", "width", "limit"),
}
DASHED = "limit"
"""Drawn as a dashed line with its name beside it: that tells it apart in a grey print."""
APART = 9.0
"""CIEDE2000 of any two lines of a chart, in any vision; about 2 is seen when two fields touch."""
SERIES_APART, SERIES_APART_GREY = 9.5, 4.0
"""Of any two of eight: in a grey print dashes and markers tell them apart as well."""


@pytest.mark.parametrize("mode", MODES)
def test_text_stands_out_from_what_it_stands_on(mode: str) -> None:
    colours = MODES[mode]
    faint = {pair: round(found, 2) for pair in TEXT if (found := contrast(*(colours[name] for name in pair))) < 4.5}
    faint |= {pair: round(found, 2) for pair in SEEN if (found := contrast(*(colours[name] for name in pair))) < 3.0}
    assert faint == {}


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("mode", MODES)
def test_lines_of_a_chart_are_told_apart(mode: str, vision: str) -> None:
    seen = {name: lab(value, vision) for name, value in MODES[mode].items() if value.startswith("#")}
    for names in CHARTS.values():
        for one, other in combinations([name for name in names if (name, vision) != (DASHED, "grey")], 2):
            assert difference(seen[one], seen[other]) >= APART, (one, other)
    least = SERIES_APART_GREY if vision == "grey" else SERIES_APART
    for one, other in combinations([f"series-{k}" for k in range(1, 7)], 2):
        assert difference(seen[one], seen[other]) >= least, (one, other)


def test_the_measure_is_the_published_one() -> None:
    """Pairs 1, 7, 13 and 25 of Sharma's table; black on white; a known contrast."""
    for one, other, found in (
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
        ((50.0, -0.001, 2.49), (50.0, 0.0011, -2.49), 4.7461),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ):
        assert difference(one, other) == pytest.approx(found, abs=1e-4)
    assert contrast("#000", "#fff") == pytest.approx(21.0) and linear("#fff") == pytest.approx((1, 1, 1))
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)
