"""Figures as pictures, drawn by matplotlib: SVG for pages and reports, and SVG, PDF and PNG files.

matplotlib is imported where it draws, so that neither `import stimrig` nor the start of the service waits for it.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import re
import textwrap
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from stimrig.api.charts.figure import LIGHT, Band, Curve, Figure, variable
from stimrig.api.charts.interactive import TOOLBAR_PX

MOST_POINTS, MOST_BAND = 2000, 250
CACHE_SIZE = 128
WIDE = ("comparison", "residual", "falling", "story-torque", "story-place")
"""Charts that a report gives its whole width."""
NARROW = 560.0
"""A narrower chart has no room for the segments' names."""
FONT_PX, LETTER_PX, LINE_PX, GAP_PX, LEFT_PX = 11.5, 6.6, 17.0, 26.0, 72.0
SETTINGS = {
    "svg.fonttype": "none", "pdf.fonttype": 42, "font.family": "DejaVu Sans", "font.size": FONT_PX,
    "axes.labelsize": FONT_PX, "xtick.labelsize": FONT_PX, "ytick.labelsize": FONT_PX, "legend.fontsize": FONT_PX,
    "text.parse_math": False, "path.simplify_threshold": 0.3, "lines.scale_dashes": False, "axes.xmargin": 0.0,
    "axes.formatter.useoffset": False, "axes.grid": True, "axes.grid.axis": "y", "axes.spines.left": False,
    "axes.spines.right": False, "axes.spines.top": False, "xtick.major.size": 0, "ytick.major.size": 0,
    "legend.frameon": False, "legend.borderpad": 0, "legend.borderaxespad": 0.3, "legend.handlelength": 1.8,
    "legend.handletextpad": 0.4, "legend.columnspacing": 1.1,
}  # fmt: skip
COLOURED = {
    "axes.edgecolor": "cursor", "grid.color": "grid", "text.color": "ink", "axes.labelcolor": "ink",
    "xtick.labelcolor": "dim", "ytick.labelcolor": "dim",
}  # fmt: skip
DASHES: dict[str, Any] = {
    "solid": "-", "dash": (0, (6, 4)), "dot": (0, (2, 3)), "dashdot": (0, (7, 3, 2, 3)), "longdash": (0, (11, 4)),
    "longdashdot": (0, (11, 3, 2, 3)),
}  # fmt: skip
MARKERS = {"circle": "o", "diamond": "D", "up": "^", "down": "v"}
STAND_INS = {name: f"#5e7f{number:02x}" for number, name in enumerate(LIGHT)}
"""Colours in place of the roles while a picture for a page is drawn."""

_lock = threading.Lock()
"""matplotlib draws in one thread at a time."""
_cache: dict[bytes, bytes] = {}
warnings.filterwarnings("ignore", r"Glyph .* missing from")  # words of a recording may hold any letter


class Figures(dict[str, Figure]):
    """Figures of a page or a file by name, for the macro of `chart.html`.

    Parameters
    ----------
    figures : dict
        By name.
    at : str
        Address of each, with `{}` for its name; in a file, which has none, each picture stands in its place.
    captions : mapping
        What stands below some of them.
    """

    def __init__(self, figures: dict[str, Figure], at: str = "", captions: Mapping[str, str] | None = None) -> None:
        super().__init__(figures)
        self.at, self.captions = at, captions or {}

    def address(self, name: str, kind: str) -> str:
        """Return where a figure is fetched: `html` for the page, `json` for plotly, `svg`, `pdf` and `png` to keep."""
        return self.at.format(f"{name}.{kind}")

    def still(self, name: str, width: float = 760.0) -> Markup:
        """Draw one of them; for a file in light colours and as wide as its place there."""
        if self.at:
            return svg(self[name], width, right=TOOLBAR_PX)
        return svg(self[name], 1120.0 if name in WIDE else 560.0, light=True)

    def file(self, name: str, kind: str, width: float = 760.0) -> bytes:
        """Draw one of them as a file: `svg`, `pdf` with its caption below, or `png`."""
        caption = self.captions.get(name, "")
        if kind == "svg":
            return svg(self[name], width, label=caption, light=True).encode()
        return _draw_cached(kind, self[name], width, 0.0, caption if kind == "pdf" else "")


def svg(
    figure: Figure, width: float = 720.0, height: float | None = None, label: str = "", light: bool = False,
    right: float = 0.0,
) -> Markup:  # fmt: skip
    """Draw a figure as an SVG element.

    Parameters
    ----------
    figure : Figure
        What is drawn.
    width, height : float
        px; default height: the figure's.
    label : str
        Text alternative; without one the element is hidden from screen readers, and what stands around it says it.
    light : bool
        In light colours on their ground, for paper and files; else the page's style sheet gives the colours.
    right : float
        px; room on the right.
    """
    sized = figure if height is None else replace(figure, height=height)
    body = _draw_cached("light" if light else "page", sized, width, right).decode()
    words = f'role="img" aria-label="{escape(label)}"' if label else 'aria-hidden="true"'
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" class="still" '
        f'viewBox="0 0 {width:g} {sized.height:g}" {words} font-family="system-ui, \'DejaVu Sans\', sans-serif" '
        f'font-size="{FONT_PX}" stroke-linejoin="round"{body}</svg>'
    )


def _draw_cached(kind: str, figure: Figure, width: float, right: float, caption: str = "") -> bytes:
    """Draw once what is asked for again and again: stored models do not change."""
    key = hashlib.sha256(pickle.dumps((kind, figure, width, right, caption))).digest()
    with _lock:
        if key not in _cache:
            while len(_cache) >= CACHE_SIZE:
                del _cache[next(iter(_cache))]
            _cache[key] = _draw(kind, figure, width, right, caption, key.hex())
        return _cache[key]


def _draw(kind: str, figure: Figure, width: float, right: float, caption: str, salt: str) -> bytes:
    import matplotlib as mpl

    colours = STAND_INS if kind == "page" else {name: _colour(value) for name, value in LIGHT.items()}
    settings: Any = {
        **SETTINGS,
        **{name: colours[role] for name, role in COLOURED.items()},
        "svg.hashsalt": salt,
        "path.simplify": all(curve.cap == "butt" for curve in figure.curves),
    }
    with mpl.rc_context(settings):
        paper, panels = _lay_out(figure, width, right, caption, colours)
        out = io.BytesIO()
        if kind in ("pdf", "png"):
            paper.savefig(out, format=kind, dpi=200, metadata={"CreationDate": None} if kind == "pdf" else None)
            return out.getvalue()
        paper.patch.set_visible(kind == "light")
        paper.savefig(out, format="svg", metadata={"Date": None})
        return _compact(out.getvalue().decode(), panels[-1]).encode()


def _colour(value: str) -> Any:
    """Return a colour of the style sheet for matplotlib."""
    if not value.startswith("rgba("):
        return value
    red, green, blue, opacity = (float(part) for part in value[5:-1].split(","))
    return red / 255, green / 255, blue / 255, opacity


def decimate(x: Sequence[float], y: Sequence[float | None], limit: int = MOST_POINTS) -> tuple[Any, Any]:
    """Keep the lowest and the highest of each few neighbours, and the gaps: about `limit` points, and no peak lost."""
    at, value = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if at.size <= limit:
        return at, value
    gaps = np.isnan(value)
    low, high = np.where(gaps, np.inf, value), np.where(gaps, -np.inf, value)
    chosen = set(np.flatnonzero(gaps))
    for part in np.array_split(np.arange(at.size), limit // 2):
        chosen |= {part[np.argmin(low[part])], part[np.argmax(high[part])]}
    rows = sorted(chosen)
    return at[rows], value[rows]


def _lay_out(
    figure: Figure, width: float, right: float, caption: str, colours: Mapping[str, Any]
) -> tuple[Any, Sequence[Any]]:
    """Return matplotlib's figure, in which a point is a px, and its panels."""
    from matplotlib.figure import Figure as Paper

    entries, count = figure.entries(), len(figure.panels)
    columns = max(1, int(width / (LETTER_PX * max((len(entry.label) for entry in entries), default=1) + 40)))
    lines = textwrap.wrap(caption, int(width / LETTER_PX))
    below, height = LINE_PX * len(lines), figure.height + LINE_PX * len(lines)
    top = 8 + LINE_PX * (-(-len(entries) // columns) + any(not label.badge for label in figure.labels))
    bottom = below + (38 if figure.x.label else 22)
    each = (height - top - bottom - GAP_PX * (count - 1)) / count
    place = {"left": LEFT_PX / width, "right": 1 - (14 + right) / width, "top": 1 - top / height,
             "bottom": bottom / height, "hspace": GAP_PX / each}  # fmt: skip
    paper = Paper((width / 72, height / 72), dpi=72, facecolor=colours["chart"])
    shares = [panel.share for panel in figure.panels]
    panels = list(paper.subplots(count, 1, sharex=True, squeeze=False, height_ratios=shares, gridspec_kw=place)[:, 0])
    _add_parts(figure, panels, colours, width)
    for panel, axes in zip(figure.panels, panels, strict=True):
        last = axes is panels[-1]
        axes.patch.set_visible(False)
        axes.spines["bottom"].set_visible(last)
        axes.tick_params(labelbottom=last)
        fits = LETTER_PX * len(panel.label) < axes.bbox.height + GAP_PX
        axes.set_ylabel(panel.label if fits else panel.label.replace(" (", "\n("))
        axes.yaxis.set_label_coords(
            (20 if fits else 32) / width, (axes.bbox.y0 + axes.bbox.y1) / 2 / height, paper.transFigure
        )
        axes.set_ylim(*(panel.limits or (0 if panel.from_zero else None, None)))
    panels[-1].set_xlabel(figure.x.label)
    panels[-1].set_xlim(figure.x.limits)
    if figure.x.ticks:
        fits = LETTER_PX * sum(len(words) + 2 for _, words in figure.x.ticks) < width - LEFT_PX
        names = [words if fits else words.split()[0] for _, words in figure.x.ticks]
        panels[-1].set_xticks([at for at, _ in figure.x.ticks], names)
    if entries:
        anchor = (LEFT_PX / width if width >= NARROW else 0.01, 1)
        handles, words = [_handle(entry, colours) for entry in entries], [entry.label.lstrip("_") for entry in entries]
        paper.legend(handles, words, loc="upper left", bbox_to_anchor=anchor, ncols=columns)
    for number, line in enumerate(lines, start=1):
        paper.text(8 / width, (below - LINE_PX * number + 4) / height, line)
    return paper, panels


def _add_parts(figure: Figure, panels: Sequence[Any], colours: Mapping[str, Any], width: float) -> None:
    for shade in figure.shades:
        style = {"facecolor": colours[shade.colour], "linewidth": 0, "zorder": 0.5}
        if shade.low is not None:
            panels[shade.panel].axhspan(shade.low, shade.high, **style)
        for axes in panels if shade.low is None else ():
            axes.axvspan(shade.start, shade.end, **style)
    for band in figure.bands:
        style = {"facecolor": colours[band.colour], "linewidth": 0, "zorder": 1.5}
        few = slice(None, None, 1 + len(band.x) // MOST_BAND)
        panels[band.panel].fill_between(band.x[few], band.lower[few], band.upper[few], **style)
    limit = min(MOST_POINTS, int(1.5 * width))
    for number, curve in enumerate(figure.curves):
        style = {**_style(curve, colours), "markevery": curve.every, "zorder": 2 + 0.01 * number}
        panels[curve.panel].plot(*decimate(curve.x, curve.y, limit), **style)
    for rule in figure.rules:
        draw = [axes.axvline for axes in panels] if rule.vertical else [panels[0].axhline]
        for line in draw:
            line(rule.at, color=colours[rule.colour], linewidth=1.4, linestyle=DASHES["dash"], zorder=3)
        at, frame = ((rule.at, 0), ("data", "axes fraction")) if rule.vertical else (
            (float(rule.right), rule.at), ("axes fraction", "data"))  # fmt: skip
        panels[0].annotate(rule.text, at, (-4 if rule.right else 4, 4), frame, "offset points",
                           color=colours[rule.colour], ha="right" if rule.right else "left")  # fmt: skip
    for label in figure.labels if width >= NARROW else [label for label in figure.labels if label.badge]:
        style = {"color": colours["mark"], "va": "bottom"}
        if label.badge:
            ground = {"facecolor": colours[label.badge], "edgecolor": "none", "pad": 3}
            style = {"color": colours["on-worst"], "va": "top", "bbox": ground}
        panels[0].annotate(label.text, (label.x, 1), (0, -6 if label.badge else 3), ("data", "axes fraction"),
                           "offset points", ha="center", annotation_clip=False, **style)  # fmt: skip


def _style(curve: Curve, colours: Mapping[str, Any]) -> dict[str, Any]:
    colour = colours[curve.colour]
    return {
        "color": colour, "linewidth": curve.width, "linestyle": DASHES[curve.dash] if curve.width else "none",
        "drawstyle": "steps-post" if curve.step else "default", "marker": MARKERS.get(curve.marker, ""),
        "markersize": curve.size, "markerfacecolor": colours["chart"] if curve.hollow else colour,
        "markeredgewidth": 1.8 if curve.hollow else 0, "solid_capstyle": curve.cap,
    }  # fmt: skip


def _handle(entry: Curve | Band, colours: Mapping[str, Any]) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(entry, Curve):
        return Line2D([], [], **_style(entry, colours))
    return Patch(facecolor=colours[entry.colour], linewidth=0)


def _compact(text: str, axes: Any) -> str:
    """Return the rest of the root's tag, with the scale of x for scripts, and what is in the root.

    matplotlib's ids, fonts and comments are left out; attributes stand in place of `style`, which the policy of an SVG
    file refuses.
    """
    body = text[text.index("</defs>") + len("</defs>") : text.rindex("</svg>")]
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r">\s+<", "><", re.sub(r"<[^>]*>", lambda tag: _shorten(tag[0]), body)).strip()
    for name, stand_in in STAND_INS.items():
        body = body.replace(stand_in, variable(name))
    body = re.sub(r"M ?([-\d.]+ [-\d.]+)L\1(?![\d.])", r"M\1h0", body)
    (low, high), (first_px, last_px) = axes.get_xlim(), axes.bbox.intervalx
    scale = f"{low:.6g} {first_px:.6g} {(last_px - first_px) / (high - low):.6g}"
    return f' data-x="{scale}">{body}'


def _shorten(tag: str) -> str:
    if tag.startswith("<g id="):
        return "<g/>" if tag.endswith("/>") else "<g>"
    tag = re.sub(r' style="([^"]*)"', lambda style: _attributes(style[1]), tag)
    tag = re.sub(r"-?\d+\.\d{2,}", lambda value: f"{float(value[0]):.1f}", " ".join(tag.split()))
    return re.sub(r" ([ML]) (?=[-\d])", r"\1", tag)


def _attributes(style: str) -> str:
    pairs = [part.strip().split(": ", 1) for part in style.split(";") if part.strip()]
    return "".join(f' {name}="{value}"' for name, value in pairs if name != "font")
