"""The certificate of a rig's check as PDF: what was measured, with what bound, by whom, and until when it holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fpdf import FPDF
from fpdf.fonts import FontFace

from stimrig.api.charts.pdf import plain

SIZE_PT, TITLE_PT, MARGIN_MM = 9.0, 16.0, 15.0
WIDTHS = 38, 58, 42, 20
VERDICTS = {
    "sound": "SOUND: every step that this rig needs has passed",
    "faults": "FAULTS FOUND: connect nobody before they are mended and the check is repeated",
    "incomplete": "INCOMPLETE: a step that this rig needs was not done",
}
EMULATED = "The devices were emulated: this says nothing of any hardware."


def certificate(report: Mapping[str, Any]) -> bytes:
    """The report of `stimrig rig check` on paper."""
    page = FPDF(format="A4")
    page.set_margin(MARGIN_MM)
    page.set_auto_page_break(True, MARGIN_MM)
    page.set_creator("stimrig")
    page.add_page()
    _line(page, "Check of a stimulation rig", TITLE_PT, "B")
    _line(page, VERDICTS[report["verdict"]], SIZE_PT + 2, "B")
    if report.get("emulated"):
        _line(page, EMULATED, SIZE_PT, "B")
    for name, value in facts(report):
        _line(page, f"{name}: {value}")
    page.ln(3)
    _steps(page, report["steps"])
    for row in report["steps"]:
        if row["fault"]:
            _line(page, f"{row['title']}: {row['cause']}. Mend: {row['mend']}.")
    page.ln(8)
    _line(page, f"Checked by {report['by']}            Signature: ____________________________")
    return bytes(page.output())


def facts(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What the head of the certificate says."""
    devices = [
        (f"{name.replace('_', ' ')}", ", ".join(f"{key} {value}" for key, value in one.items() if value) or "none")
        for name, one in report["devices"].items()
    ]
    return [
        ("Checked (UTC)", report["checked_at_utc"]),
        ("Due again (UTC)", report["due_at_utc"]),
        ("Software", report["software"]),
        ("Rig file", f"{report.get('rig_file', 'emulator')}, SHA-256 {report.get('rig_file_sha256', '-')}"),
        ("Devices, limits and watch, SHA-256", report["rig"]),
        *devices,
        ("Dummy load", f"{report['dummy_load_ohm']:g} Ω"),
    ]


def _steps(page: FPDF, rows: list[dict[str, str]]) -> None:
    page.set_font("helvetica", size=SIZE_PT - 1)
    bold = FontFace(emphasis="BOLD")
    with page.table(col_widths=WIDTHS, headings_style=bold, text_align="LEFT") as table:
        table.row(["Step", "Found", "Must be", "Result"])
        for row in rows:
            style = bold if row["outcome"] == "failed" else None
            table.row([plain(row[key]) for key in ("title", "figure", "bound", "outcome")], style=style)
    page.ln(3)


def _line(page: FPDF, text: str, size_pt: float = SIZE_PT, style: str = "") -> None:
    page.set_font("helvetica", style=style, size=size_pt)
    page.multi_cell(0, 0.5 * size_pt, plain(text), new_x="LMARGIN", new_y="NEXT")
