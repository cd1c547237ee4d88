"""The pages' colours as the style sheets give them, and how eyes see them: contrast, colour-blindness, difference.

Contrast: WCAG 2.2, definitions of contrast ratio and relative luminance. Dichromacy: Machado, Oliveira and Fernandes,
"A physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15(6), 2009, table 1, severity 1.0,
applied to linear RGB. Difference: CIEDE2000 as in Sharma, Wu and Dalal, Color Res. Appl. 30(1), 2005.
"""

from __future__ import annotations

import re
from math import atan2, cos, degrees, exp, hypot, radians, sin, sqrt

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
