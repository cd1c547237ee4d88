"""A figure as a file for a paper: SVG, or PDF with lines and letters."""

from __future__ import annotations

from fpdf import FPDF
from fpdf.svg import SVGObject

from stimrig.api.charts.svg import Figures, svg

WITHOUT = {
    "−": "-",
    "–": "-",
    "→": ">",
    "‹": "<",
    "›": ">",
    "ω": "w",
    "ζ": "z",
    "Δ": "D",
    "·": "\u00b7",
    "Ω": "Ohm",
    "…": "...",
}
"""What the fonts that every reader of PDF has do not hold."""
CAPTION_PT, PAGE_PT = 10.0, 760.0
MARGIN_PT = 8.0


def paper(figures: Figures, name: str, kind: str, width: float = PAGE_PT) -> bytes:
    """A figure to keep: as SVG with the light colours in it, or as PDF, one page with its caption below.

    Parameters
    ----------
    figures : Figures
        Of which one is drawn.
    name : str
        Its name.
    kind : str
        "svg" or "pdf".
    width : float
        pt.
    """
    height, caption = figures.height(name), figures.captions.get(name, "")
    still = svg(figures[name], width, height, caption, on_paper=True)
    if kind == "svg":
        return still.encode()
    page = FPDF(unit="pt", format=(width, height + (6.0 * CAPTION_PT if caption else 0.0)))
    page.set_margin(MARGIN_PT)
    page.set_auto_page_break(False)
    page.add_page()
    page.set_creator("stimrig")
    drawn = SVGObject(plain(still))
    drawn.width, drawn.height = width, height
    drawn.draw_to_page(page, 0, 0)
    page.set_font("helvetica", size=CAPTION_PT)
    page.set_xy(MARGIN_PT, height + MARGIN_PT)
    page.multi_cell(width - 2 * MARGIN_PT, 1.3 * CAPTION_PT, plain(caption))
    return bytes(page.output())


def plain(text: str) -> str:
    """The text in letters that these fonts hold."""
    for sign, other in WITHOUT.items():
        text = text.replace(sign, other)
    return str(text).encode("latin-1", "replace").decode("latin-1")
