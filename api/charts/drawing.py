"""Figures as pictures, drawn by matplotlib: SVG for pages and reports, and SVG, PDF and PNG files.

matplotlib is imported where it draws, so that neither `import stimrig` nor the start of the service waits for it.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import threading
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from stimrig.api.charts.figure import GAP_PX, LIGHT, TOOLBAR_PX, Figure, variable

MOST_BAND = 250
"""Points of a band: unlike those of a line matplotlib keeps them all."""
WIDE = ("comparison", "residual", "falling", "story-torque", "story-place")
"""Charts that a report gives its whole width."""
NARROW = 560.0
"""A narrower chart has no room for the segments' names."""
FONT_PX, LETTER_PX, LINE_PX, LEFT_PX = 11.5, 6.6, 17.0, 72.0
SETTINGS = {
    "svg.fonttype": "none", "pdf.fonttype": 42, "font.family": "DejaVu Sans", "font.size": FONT_PX,
    "axes.labelsize": FONT_PX, "xtick.labelsize": FONT_PX, "ytick.labelsize": FONT_PX, "legend.fontsize": FONT_PX,
    "text.parse_math": False, "path.simplify_threshold": 0.8, "lines.scale_dashes": False, "axes.xmargin": 0.0,
    "lines.solid_capstyle": "butt",
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
MARKERS = {"circle": "o", "diamond": "D", "triangle-up": "^", "triangle-down": "v"}
STAND_INS = {name: f"#5e7f{number:02x}" for number, name in enumerate(LIGHT)}
"""Colours in place of the roles while a picture for a page is drawn."""

_lock = threading.Lock()
"""matplotlib draws in one thread at a time."""
warnings.filterwarnings("ignore", r"Glyph .* missing from")  # words of a recording may hold any letter


class Figures(dict[str, Figure]):
    """Figures by name for the macro of `chart.html`: of a page, with the address of all in `at`, or of a file."""

    def __init__(self, figures: Mapping[str, Figure], at: str = "") -> None:
        super().__init__(figures)
        self.at = at

    def still(self, name: str, width: float) -> Markup:
        """Draw one of them; for a file in light colours and as wide as its place there."""
        if self.at:
            return svg(self[name], width, right=TOOLBAR_PX)
        return svg(self[name], 1120.0 if name in WIDE else 560.0, light=True)


def svg(
    figure: Figure, width: float = 720.0, height: float | None = None, label: str = "", light: bool = False,
    right: float = 0.0,
) -> Markup:  # fmt: skip
    """Draw a figure as an SVG element of some `width` and `height`, with room on the `right` (px).

    Its colours are those of the page's style sheet, or `light` ones on their ground, for paper and files. `label`: text
    alternative; without one the element is hidden from screen readers, and what stands around it says it.
    """
    height = height or figure["layout"]["height"]
    body = _draw("light" if light else "page", json.dumps(figure), width, height, right).decode()
    words = f'role="img" aria-label="{escape(label)}"' if label else 'aria-hidden="true"'
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" class="still" '
        f'viewBox="0 0 {width:g} {height:g}" {words} font-family="system-ui, \'DejaVu Sans\', sans-serif" '
        f'font-size="{FONT_PX}" stroke-linejoin="round">{body}</svg>'
    )


def file(figure: Figure, kind: str, width: float = 760.0) -> bytes:
    """Draw a figure as a file in light colours: `svg`, `pdf` or `png`."""
    if kind == "svg":
        return svg(figure, width, light=True).encode()
    return _draw(kind, json.dumps(figure), width, figure["layout"]["height"], 0.0)


@lru_cache(128)  # the same is asked for again and again: stored models do not change
def _draw(kind: str, figure_json: str, width: float, height: float, right: float) -> bytes:
    import matplotlib as mpl

    colours = STAND_INS if kind == "page" else {role: _colour(value) for role, value in LIGHT.items()}
    figure = json.loads(figure_json)
    settings: Any = {
        **SETTINGS,
        **{setting: colours[role] for setting, role in COLOURED.items()},
        "svg.hashsalt": hashlib.sha256(figure_json.encode()).hexdigest(),  # pictures of one page share no ids
    }
    out = io.BytesIO()
    with _lock, mpl.rc_context(settings):
        paper = _lay_out(figure, width, height, right, {variable(role): colours[role] for role in colours})
        if kind in ("pdf", "png"):
            paper.savefig(out, format=kind, dpi=200, metadata={"CreationDate": None} if kind == "pdf" else None)
            return out.getvalue()
        paper.patch.set_visible(kind == "light")
        paper.savefig(out, format="svg", metadata={"Date": None})
    return _compact(out.getvalue().decode()).encode()


def _colour(value: str) -> Any:
    """Return a colour of the style sheet for matplotlib."""
    if not value.startswith("rgba("):
        return value
    red, green, blue, opacity = (float(part) for part in value[5:-1].split(","))
    return red / 255, green / 255, blue / 255, opacity


def _lay_out(figure: Figure, width: float, height: float, right: float, colours: Mapping[str, Any]) -> Any:
    """Return matplotlib's figure, in which a point is a px. Its margins follow from the legend and the labels."""
    from matplotlib.figure import Figure as Paper

    layout = figure["layout"]
    settings = [layout[key] for key in sorted(key for key in layout if key.startswith("yaxis"))]
    listed = [trace for trace in figure["data"] if trace["showlegend"]] if layout["showlegend"] else []
    columns = max(1, int(width / (LETTER_PX * max((len(trace["name"]) for trace in listed), default=1) + 40)))
    named = any("bgcolor" not in note for note in layout["annotations"])
    top = 8 + LINE_PX * (-(-len(listed) // columns) + named)
    bottom = 38 if layout["xaxis"]["title"]["text"] else 22
    each = (height - top - bottom - GAP_PX * (len(settings) - 1)) / len(settings)
    place = {"left": LEFT_PX / width, "right": 1 - (14 + right) / width, "top": 1 - top / height,
             "bottom": bottom / height, "hspace": GAP_PX / each}  # fmt: skip
    paper = Paper((width / 72, height / 72), dpi=72, facecolor=colours[variable("chart")])
    shares = [setting["domain"][1] - setting["domain"][0] for setting in settings]
    panels = list(
        paper.subplots(len(settings), 1, sharex=True, squeeze=False, height_ratios=shares, gridspec_kw=place)[:, 0]
    )
    handles = _draw_traces(figure["data"], panels, colours)
    for shape in layout["shapes"]:
        _draw_shape(shape, panels, colours)
    for note in layout["annotations"]:
        if "bgcolor" in note or width >= NARROW:
            _draw_note(note, panels[0], colours)
    for setting, axes in zip(settings, panels, strict=True):
        last, label = axes is panels[-1], setting["title"]["text"]
        axes.patch.set_visible(False)
        axes.spines["bottom"].set_visible(last)
        axes.tick_params(labelbottom=last)
        fits = LETTER_PX * len(label) < axes.bbox.height + GAP_PX
        axes.set_ylabel(label if fits else label.replace(" (", "\n("))
        middle = (axes.bbox.y0 + axes.bbox.y1) / 2 / height
        axes.yaxis.set_label_coords((20 if fits else 32) / width, middle, paper.transFigure)
        axes.set_ylim(*setting.get("range", (0 if "rangemode" in setting else None, None)))
    axes, setting = panels[-1], layout["xaxis"]
    axes.set_xlabel(setting["title"]["text"])
    axes.set_xlim(setting.get("range"))
    if ticks := setting.get("ticktext"):
        fits = LETTER_PX * sum(len(words) + 2 for words in ticks) < width - LEFT_PX
        axes.set_xticks(setting["tickvals"], ticks if fits else [words.split()[0] for words in ticks])
    if listed:
        anchor = (LEFT_PX / width if width >= NARROW else 0.01, 1)
        entries = [(handle, trace["name"].lstrip("_")) for handle, trace in handles if trace["showlegend"]]
        paper.legend(*zip(*entries, strict=True), loc="upper left", bbox_to_anchor=anchor, ncols=columns)
    return paper


def _draw_traces(
    traces: Sequence[dict[str, Any]], panels: Sequence[Any], colours: Mapping[str, Any]
) -> list[tuple[Any, dict[str, Any]]]:
    """Draw curves and bands; return of each its handle for the legend."""
    handles = []
    for number, trace in enumerate(traces):
        axes, line = panels[int(trace["yaxis"][1:] or 1) - 1], trace["line"]
        if "fill" in trace:
            few, upper = slice(None, None, 1 + len(trace["x"]) // MOST_BAND), traces[number - 1]["y"]
            style = {"facecolor": colours[trace["fillcolor"]], "linewidth": 0, "zorder": 1.5}
            handles.append((axes.fill_between(trace["x"][few], trace["y"][few], upper[few], **style), trace))
        elif line["width"] or "marker" in trace:
            style = {"color": colours[line["color"]], "linewidth": line["width"], "zorder": 2 + 0.01 * number,
                     "linestyle": DASHES[line["dash"]] if line["width"] else "none",
                     "drawstyle": "steps-post" if line["shape"] == "hv" else "default"}  # fmt: skip
            if marker := trace.get("marker"):
                style |= {"marker": MARKERS[marker["symbol"]], "markersize": marker["size"],
                          "markerfacecolor": colours[marker["color"]], "markeredgewidth": marker["line"]["width"],
                          "markevery": -(-len(trace["x"]) // (marker["maxdisplayed"] or len(trace["x"])))}  # fmt: skip
            handles += [(handle, trace) for handle in axes.plot(trace["x"], np.array(trace["y"], dtype=float), **style)]
    return handles


def _draw_shape(shape: dict[str, Any], panels: Sequence[Any], colours: Mapping[str, Any]) -> None:
    across = shape["xref"] == "paper"
    if shape["type"] == "rect":
        style = {"facecolor": colours[shape["fillcolor"]], "linewidth": 0, "zorder": 0.5}
        for axes in [] if across else panels:
            axes.axvspan(shape["x0"], shape["x1"], **style)
        if across:
            panels[int(shape["yref"][1:] or 1) - 1].axhspan(shape["y0"], shape["y1"], **style)
        return
    colour, label, right = colours[shape["line"]["color"]], shape["label"], shape["label"]["textposition"] == "end"
    for draw in [panels[0].axhline] if across else [axes.axvline for axes in panels]:
        draw(shape["y0" if across else "x0"], color=colour, linewidth=1.4, linestyle=DASHES["dash"], zorder=3)
    at, frame = ((float(right), shape["y0"]), ("axes fraction", "data")) if across else (
        (shape["x0"], 0), ("data", "axes fraction"))  # fmt: skip
    panels[0].annotate(label["text"], at, (-4 if right else 4, 4), frame, "offset points", color=colour,
                       ha="right" if right else "left")  # fmt: skip


def _draw_note(note: dict[str, Any], axes: Any, colours: Mapping[str, Any]) -> None:
    style: dict[str, Any] = {"color": colours[note["font"]["color"]], "va": "bottom"}
    if ground := note.get("bgcolor"):
        style |= {"va": "top", "bbox": {"facecolor": colours[ground], "edgecolor": "none", "pad": 3}}
    axes.annotate(note["text"], (note["x"], 1), (0, -6 if ground else 3), ("data", "axes fraction"), "offset points",
                  ha="center", annotation_clip=False, **style)  # fmt: skip


def _compact(picture: str) -> str:
    """Return what is in the root of matplotlib's SVG without its ids, fonts and comments.

    Attributes stand in place of `style`, which the policy of an SVG file refuses.
    """
    body = picture[picture.index("</defs>") + len("</defs>") : picture.rindex("</svg>")]
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r">\s+<", "><", re.sub(r"<[^>]*>", lambda tag: _shorten(tag[0]), body)).strip()
    for role, stand_in in STAND_INS.items():
        body = body.replace(stand_in, variable(role))
    return re.sub(r"M ?([-\d.]+ [-\d.]+)L\1(?![\d.])", r"M\1h0", body)


def _shorten(tag: str) -> str:
    if tag.startswith("<g id="):
        return "<g/>" if tag.endswith("/>") else "<g>"
    tag = re.sub(r' style="([^"]*)"', lambda style: _attributes(style[1]), tag)
    tag = re.sub(r"-?\d+\.\d{2,}", lambda value: f"{float(value[0]):.1f}", " ".join(tag.split()))
    return re.sub(r" ([ML]) (?=[-\d])", r"\1", tag)


def _attributes(style: str) -> str:
    pairs = [part.strip().split(": ", 1) for part in style.split(";") if part.strip()]
    return "".join(f' {name}="{value}"' for name, value in pairs if name != "font")
