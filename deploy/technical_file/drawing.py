"""The data-flow diagram of the threat model as SVG: boundaries are dashed columns, flows are numbered arrows."""

from __future__ import annotations

from html import escape

from deploy.technical_file.places import Row

COLUMN, GAP, ROW, WIDE, HIGH, TOP = 390, 60, 96, 190, 44, 60


def draw(threats: Row) -> str:
    """Elements stand in their boundary's column, in the order of the table."""
    homes = [row["id"] for row in threats["boundary"]]
    columns = [[row for row in threats["element"] if row["boundary"] == home] for home in homes]
    at = {
        row["id"]: (40 + COLUMN * column, TOP + ROW * place)
        for column, rows in enumerate(columns)
        for place, row in enumerate(rows)
    }
    width, height = COLUMN * len(homes) - GAP + 8, TOP + ROW * max(map(len, columns))
    parts = [_boundary(row["title"], number, height) for number, row in enumerate(threats["boundary"])]
    parts += [_flow(number, at[row["from"]], at[row["to"]]) for number, row in enumerate(threats["flow"], 1)]
    parts += [_element(row, *at[row["id"]]) for row in threats["element"]]
    style = "text{font:13px sans-serif;text-anchor:middle}rect,path,line{fill:none;stroke:#333}.b{stroke-dasharray:6 4}"
    arrow = (
        '<marker id="a" viewBox="0 0 9 9" refX="9" refY="4.5" markerWidth="9" markerHeight="9" orient="auto">'
        '<path d="M0 0 9 4.5 0 9z" style="fill:#333"/></marker>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="Data flows and trust boundaries"><style>{style}</style><defs>{arrow}</defs>{"".join(parts)}</svg>'
    )


def _boundary(title: str, number: int, height: int) -> str:
    left = COLUMN * number + 8
    box = f'<rect class="b" x="{left}" y="8" width="{COLUMN - GAP}" height="{height - 16}" rx="8"/>'
    return f'{box}<text x="{left + (COLUMN - GAP) / 2}" y="30">{escape(title)}</text>'


def _element(row: Row, left: float, top: float) -> str:
    """A process is round, a store has a double line, people and devices are square."""
    corner = 20 if row["kind"] == "process" else 0
    box = f'<rect x="{left}" y="{top}" width="{WIDE}" height="{HIGH}" rx="{corner}" style="fill:#fff"/>'
    if row["kind"] == "store":
        box += f'<line x1="{left}" y1="{top + 5}" x2="{left + WIDE}" y2="{top + 5}"/>'
    return f'{box}<text x="{left + WIDE / 2}" y="{top + HIGH / 2 + 5}">{escape(row["title"])}</text>'


def _flow(number: int, start: tuple[float, float], end: tuple[float, float]) -> str:
    """A straight arrow between columns; within one a bow on the right, each of another width."""
    (x1, y1), (x2, y2) = start, end
    y1, y2 = y1 + HIGH / 2, y2 + HIGH / 2
    if x1 == x2:
        edge, bow = x1 + WIDE, x1 + WIDE + 24 + number % 6 * 17
        line, x, y = f"M{edge} {y1}C{bow} {y1} {bow} {y2} {edge} {y2}", (edge + 3 * bow) / 4, (y1 + y2) / 2
    else:
        x1, x2 = (x1 + WIDE, x2) if x1 < x2 else (x1, x2 + WIDE)
        line, x, y = f"M{x1} {y1}L{x2} {y2}", x1 + (x2 - x1) / 3, y1 + (y2 - y1) / 3
    return (
        f'<path d="{line}" marker-end="url(#a)"/><circle cx="{x}" cy="{y}" r="9" fill="#fff" stroke="#333"/>'
        f'<text x="{x}" y="{y + 4}">{number}</text>'
    )
