"""Figures as data, and their pictures by matplotlib: SVG for pages, reports and notebooks; SVG, PDF and PNG files.

A figure has panels one above another over one x axis, and marks in them. Colours are roles: `--role` of `page.css`, so
that a page shows its pictures light or dark; those of files are light. matplotlib is imported where it draws: neither
`import stimrig` nor the start of the service waits for it.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import re
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

SHEET = Path(__file__).parents[1] / "web" / "pages" / "static" / "page.css"
FILE_KINDS = ("svg", "pdf", "png")
NARROW_PX = 560.0
"""A narrower picture has no room for the segments' names."""
MOST_BAND = 250
"""Points of a band: unlike those of a line matplotlib keeps them all."""
GAP_PX, FONT_PX, LETTER_PX, LINE_PX, LEFT_PX = 30, 11.5, 6.6, 17.0, 72.0
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
DASHES: dict[str, Any] = {"solid": "-", "dash": (0, (6, 4)), "dot": (0, (2, 3))}

_lock = threading.Lock()
"""matplotlib draws in one thread at a time."""
warnings.filterwarnings("ignore", r"Glyph .* missing from")  # words of a recording may hold any letter


def _read_light() -> dict[str, Any]:
    """Read the light colours of `page.css` by role; a role that refers to another one has that one's colour."""
    sheet = SHEET.read_text("utf-8")
    values = re.findall(r"--([\w-]+): ([^;]+);", sheet[: sheet.index("\n}")])
    colours = {name: value.removeprefix("light-dark(").partition(", ")[0] for name, value in values}
    return {name: colours.get(value.removeprefix("var(--").rstrip(")"), value) for name, value in colours.items()}


LIGHT = _read_light()
STAND_INS = {role: f"#5e7f{number:02x}" for number, role in enumerate(LIGHT)}
"""Colours in place of the roles while a picture for a page is drawn."""


@dataclass(frozen=True)
class Axis:
    """An axis: its quantity with the unit; `ticks` stand in place of numbers."""

    label: str
    limits: tuple[float, float] | None = None
    ticks: Sequence[tuple[float, str]] = ()
    from_zero: bool = False


def time_axis(start_s: float, end_s: float) -> Axis:
    """Return the axis of time."""
    return Axis("Time (s)", (start_s, end_s))


@dataclass(frozen=True)
class Line:
    """Points joined by a line, which None breaks; without `width` only markers are drawn."""

    x: Sequence[float]
    y: Sequence[float | None]
    label: str = ""
    colour: str = "model"
    width: float = 1.6
    _: KW_ONLY
    dash: str = "solid"
    step: bool = False
    panel: int = 0
    marker: str = ""
    size: float = 8
    most_markers: int = 0
    listed: bool = True


@dataclass(frozen=True)
class Band:
    """The area between two curves of the first panel."""

    x: Sequence[float]
    lower: Sequence[float]
    upper: Sequence[float]
    label: str = "95 % band"
    colour: str = "model-band"
    listed: bool = True


@dataclass(frozen=True)
class Shade:
    """A stretch of x over all panels; with `panel` a range of that panel's values over all x."""

    colour: str
    start: float
    end: float
    panel: int | None = None


@dataclass(frozen=True)
class Rule:
    """A dashed line at a value of the first panel, or upright at a place on the x axis, with its words."""

    at: float
    words: str = ""
    colour: str = "limit"
    _: KW_ONLY
    upright: bool = False
    right: bool = False


@dataclass(frozen=True)
class Note:
    """A name above the panels; with a `ground` of some colour a number at their top."""

    x: float
    words: str
    ground: str = ""


Mark = Line | Band | Shade | Rule | Note


@dataclass(frozen=True)
class Figure:
    """Panels, which share `height` (px), and the marks in them."""

    x: Axis
    panels: Sequence[Axis]
    marks: Sequence[Mark]
    height: float = 340.0
    shares: Sequence[float] = (1.0,)

    def lines(self) -> dict[str, Line]:
        """Return the lines that have a label, by label."""
        return {mark.label: mark for mark in self.marks if isinstance(mark, Line) and mark.label}

    def svg(
        self,
        width: float = 720.0,
        height: float | None = None,
        label: str = "",
        light: bool = False,
        right: float = 0.0,
    ) -> Markup:
        """Draw an SVG element of some `width` and `height`, with room on the `right` (px).

        Its colours are those of the page's style sheet, or `light` ones on their ground, for paper and files. `label`:
        text alternative; without one the element is hidden from screen readers, and what stands around it says it.
        """
        height = height or self.height
        body = _draw("light" if light else "page", pickle.dumps(self), width, height, right).decode()
        words = f'role="img" aria-label="{escape(label)}"' if label else 'aria-hidden="true"'
        return Markup(
            '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" class="still" '
            f'viewBox="0 0 {width:g} {height:g}" {words} font-family="system-ui, \'DejaVu Sans\', sans-serif" '
            f'font-size="{FONT_PX}" stroke-linejoin="round">{body}</svg>'
        )

    def file(self, kind: str, width: float = 760.0) -> bytes:
        """Draw a file in light colours: `svg`, `pdf` or `png`."""
        if kind == "svg":
            return self.svg(width, light=True).encode()
        return _draw(kind, pickle.dumps(self), width, self.height, 0.0)

    def save(self, path: str | Path) -> None:
        """Write a file; the suffix of its name says the kind: .svg, .pdf or .png."""
        kind = Path(path).suffix.removeprefix(".")
        if kind not in FILE_KINDS:
            raise ValueError(f"{path}: a figure is saved as .svg, .pdf or .png")
        Path(path).write_bytes(self.file(kind))

    def _repr_html_(self) -> str:
        return str(self.svg(light=True))


class Figures(dict[str, Figure]):
    """Figures by name for the macro of `chart.html`: of a page, with the address of all in `at`, or of a file."""

    TOOLS_PX = 42.0
    """On the right of a chart of a page: its button covers no line there."""
    WIDE = ("comparison", "residual", "falling", "story-torque", "story-place")
    """Charts that a report gives its whole width."""

    def __init__(self, figures: Mapping[str, Figure], at: str = "") -> None:
        super().__init__(figures)
        self.at = at

    def still(self, name: str, width: float) -> Markup:
        """Draw one of them; for a file in light colours and as wide as its place there."""
        if self.at:
            return self[name].svg(width, right=self.TOOLS_PX)
        return self[name].svg(1120.0 if name in self.WIDE else 560.0, light=True)


# ---- drawing --------------------------------------------------------------------------------------------------------


@lru_cache(128)  # the same is asked for again and again: stored models do not change
def _draw(kind: str, pickled: bytes, width: float, height: float, right: float) -> bytes:
    import matplotlib as mpl

    colours = STAND_INS if kind == "page" else {role: _colour(value) for role, value in LIGHT.items()}
    settings: Any = {
        **SETTINGS,
        **{setting: colours[role] for setting, role in COLOURED.items()},
        "svg.hashsalt": hashlib.sha256(pickled).hexdigest(),  # pictures of one page share no ids
    }
    out = io.BytesIO()
    with _lock, mpl.rc_context(settings):
        paper = _lay_out(pickle.loads(pickled), width, height, right, colours)
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

    listed = [mark for mark in figure.marks if isinstance(mark, Line | Band) and mark.listed and mark.label]
    listed = listed if len(listed) > 1 else []
    columns = max(1, int(width / (LETTER_PX * max((len(mark.label) for mark in listed), default=1) + 40)))
    named = any(isinstance(mark, Note) and not mark.ground for mark in figure.marks)
    top = 8 + LINE_PX * (-(-len(listed) // columns) + named)
    bottom, count = 38 if figure.x.label else 22, len(figure.panels)
    each = (height - top - bottom - GAP_PX * (count - 1)) / count
    place = {"left": LEFT_PX / width, "right": 1 - (14 + right) / width, "top": 1 - top / height,
             "bottom": bottom / height, "hspace": GAP_PX / each}  # fmt: skip
    paper = Paper((width / 72, height / 72), dpi=72, facecolor=colours["chart"])
    panels = list(
        paper.subplots(count, 1, sharex=True, squeeze=False, height_ratios=figure.shares, gridspec_kw=place)[:, 0]
    )
    handles = {}
    for number, mark in enumerate(figure.marks):
        if not isinstance(mark, Note) or mark.ground or width >= NARROW_PX:
            handles[id(mark)] = _draw_mark(mark, number, panels, colours)
    for axis, axes in zip(figure.panels, panels, strict=True):
        axes.patch.set_visible(False)
        axes.spines["bottom"].set_visible(axes is panels[-1])
        axes.tick_params(labelbottom=axes is panels[-1])
        fits = LETTER_PX * len(axis.label) < axes.bbox.height + GAP_PX
        axes.set_ylabel(axis.label if fits else axis.label.replace(" (", "\n("))
        middle = (axes.bbox.y0 + axes.bbox.y1) / 2 / height
        axes.yaxis.set_label_coords((20 if fits else 32) / width, middle, paper.transFigure)
        axes.set_ylim(*(axis.limits or (0 if axis.from_zero else None, None)))
    panels[-1].set_xlabel(figure.x.label)
    panels[-1].set_xlim(figure.x.limits)
    if ticks := figure.x.ticks:
        fits = LETTER_PX * sum(len(words) + 2 for _at, words in ticks) < width - LEFT_PX
        panels[-1].set_xticks([at for at, _ in ticks], [words if fits else words.split()[0] for _, words in ticks])
    if listed:
        anchor = (LEFT_PX / width if width >= NARROW_PX else 0.01, 1)
        entries = [(handles[id(mark)], mark.label.lstrip("_")) for mark in listed]
        paper.legend(*zip(*entries, strict=True), loc="upper left", bbox_to_anchor=anchor, ncols=columns)
    return paper


def _draw_mark(mark: Mark, number: int, panels: Sequence[Any], colours: Mapping[str, Any]) -> Any:
    """Draw a mark; return the handle of a line or a band for the legend."""
    match mark:
        case Line(x=x, y=y, marker=marker):
            style = {"color": colours[mark.colour], "linewidth": mark.width, "zorder": 2 + 0.01 * number,
                     "linestyle": DASHES[mark.dash] if mark.width else "none",
                     "drawstyle": "steps-post" if mark.step else "default"}  # fmt: skip
            if marker:
                style |= {"marker": marker, "markersize": mark.size, "markeredgewidth": 0,
                          "markevery": -(-len(x) // (mark.most_markers or len(x)))}  # fmt: skip
            return panels[mark.panel].plot(x, [float("nan") if value is None else value for value in y], **style)[0]
        case Band(x=x, lower=lower, upper=upper):
            few = slice(None, None, 1 + len(x) // MOST_BAND)
            style = {"facecolor": colours[mark.colour], "linewidth": 0, "zorder": 1.5}
            return panels[0].fill_between(x[few], lower[few], upper[few], **style)
        case Shade(colour=colour, start=start, end=end, panel=panel):
            style = {"facecolor": colours[colour], "linewidth": 0, "zorder": 0.5}
            for fill in [axes.axvspan for axes in panels] if panel is None else [panels[panel].axhspan]:
                fill(start, end, **style)
        case Rule(at=at, upright=upright, right=right):
            colour = colours[mark.colour]
            for draw in [axes.axvline for axes in panels] if upright else [panels[0].axhline]:
                draw(at, color=colour, linewidth=1.4, linestyle=DASHES["dash"], zorder=3)
            place, frame = ((at, 0), ("data", "axes fraction")) if upright else (
                (float(right), at), ("axes fraction", "data"))  # fmt: skip
            panels[0].annotate(mark.words, place, (-4 if right else 4, 4), frame, "offset points", color=colour,
                               ha="right" if right else "left")  # fmt: skip
        case Note(ground=ground):
            style = {"color": colours["on-worst" if ground else "mark"], "va": "top" if ground else "bottom"}
            if ground:
                style["bbox"] = {"facecolor": colours[ground], "edgecolor": "none", "pad": 3}
            panels[0].annotate(mark.words, (mark.x, 1), (0, -6 if ground else 3), ("data", "axes fraction"),
                               "offset points", ha="center", annotation_clip=False, **style)  # fmt: skip
    return None


def _compact(picture: str) -> str:
    """Return what is in the root of matplotlib's SVG without its ids, fonts and comments.

    Attributes stand in place of `style`, which the policy of an SVG file refuses.
    """
    body = picture[picture.index("</defs>") + len("</defs>") : picture.rindex("</svg>")]
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    body = re.sub(r">\s+<", "><", re.sub(r"<[^>]*>", lambda tag: _shorten(tag[0]), body)).strip()
    for role, stand_in in STAND_INS.items():
        body = body.replace(stand_in, f"var(--{role})")
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
