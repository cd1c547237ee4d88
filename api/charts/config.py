"""What every drawn chart may do, on pages, in reports, in notebooks: look closer, and save a picture on this machine.

The plot library's own set of buttons offers to upload the chart, with a person's torque in it, to its maker's cloud.
Buttons are therefore named one by one: a later version's new ones stay away, too.
"""

from __future__ import annotations

from typing import Any

from stimrig.api.language import lazy

CHART_CONFIG: dict[str, Any] = {
    "responsive": True,
    "displaylogo": False,
    "showSendToCloud": False,
    "plotlyServerURL": "",
    "modeBarButtons": [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]],
    "displayModeBar": True,
}


PAGE_CONFIG: dict[str, Any] = {
    **CHART_CONFIG,
    "locale": "page",
    "locales": {
        "page": {
            "format": {},
            "dictionary": {
                "Download plot as a PNG": lazy("Save as a picture"),
                "Download plot": lazy("Save as a picture"),
                "Zoom": lazy("Zoom: draw a box"),
                "Pan": lazy("Move"),
                "Reset axes": lazy("Show all again"),
            },
        }
    },
}
"""On a page: the buttons' words in its language."""


def said(words: str) -> str:
    """Words of a recording or of a user's own effect, for a chart: `<a href=…>` would become a link there."""
    return words.replace("<", "‹").replace(">", "›")
