"""Every text can be read in light and in dark, and the charts' colours are told apart by everybody."""

from __future__ import annotations

import re
from itertools import combinations

import pytest

from tests.api.colours import STATIC, VISION, contrast, difference, lab, linear, modes, variables

MODES = modes()
SURFACES = ("card", "paper", "soft", "chosen", "chart")
TEXT = [
    *((ink, surface) for surface in SURFACES for ink in ("ink", "dim", "accent", "accent-dark")),
    *((ink, kind + "-bg") for kind in ("good", "warn", "bad") for ink in (kind, kind + "-ink", "ink", "dim")),
    *((f"on-{name}", name) for name in ("primary", "stimulate", "stop", "tag", "running", "unknown", "emulated")),
    *((f"on-{name}", f"{name}-hover") for name in ("primary", "stimulate", "stop")),
    ("ink", "field"), ("bad", "card"), ("mark", "chart"), ("on-worst", "worst"),
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


def test_a_rule_that_sets_ink_and_surface_sets_a_pair_that_is_checked() -> None:
    """`--stop` with `--on-accent`, say, might be read in one mode only."""
    pairs = set(TEXT) | {("on-off", "off")}
    for path in STATIC.glob("*.css"):
        for rule in re.findall(r"\{([^{}]*)\}", path.read_text("utf-8")):
            ink = re.search(r"(?:^|[;\s])color: var\(--([\w-]+)\)", rule)
            surface = re.search(r"background(?:-color)?: var\(--([\w-]+)\)", rule)
            if ink and surface:
                assert (ink[1], surface[1]) in pairs, (path.name, rule)


def test_colours_stand_in_the_two_lists_only() -> None:
    """A colour that a rule holds itself would stay as it is in the dark."""
    light, dark = variables("page.css"), variables("dark.css")
    kept = {"bar", "stop-width", "torque"}  # two lengths, and a name for another colour
    assert set(light) - kept == set(dark), "both lists name the same"
    for path in STATIC.glob("*.css"):
        rules = re.sub(r":root \{.*?\n\}|/\*.*?\*/", "", path.read_text("utf-8"), count=0, flags=re.DOTALL)
        literal = re.findall(r"[:,\s](#[0-9a-fA-F]{3,8}\b|rgba?\([^)]*\)|\bwhite\b|\bblack\b)(?=[;,\s}])", rules)
        assert literal == [], path.name
        used = set(re.findall(r"var\(--([\w-]+)\)", rules))
        assert used - set(light) == set(), path.name


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
