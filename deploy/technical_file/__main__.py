"""`python -m deploy.technical_file`: the technical file as Markdown pages and as one HTML page to print.

    python -m deploy.technical_file                         into build/technical-file/
    python -m deploy.technical_file --dist dist --tests tests.xml    with the release record filled
    python -m deploy.technical_file --check                 write nothing; what does not hold, a line each
    python -m deploy.technical_file --sbom build/sbom.json  the bill of materials alone

Exit 0: done. 1: file and code part; nothing was written. 2: a mistake in the arguments. Needs the test environment.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from deploy.technical_file import checks, parts, places, release, sbom
from deploy.technical_file.places import ROOT, SAFETY, Tables

PAGES = (
    "README", "intended-use", "risk-management", "life-cycle", "use", "stimulator-standard", "security",
    "data-protection", "outside",
)  # fmt: skip
"""Pages of docs/safety in the order of the printed file."""
MARK = re.compile(r"<!-- table: ([a-z-]+) -->")
STYLE = (
    "body{font:11pt/1.45 serif;max-width:60em;margin:2em auto;padding:0 1em}table{border-collapse:collapse;width:100%}"
    "td,th{border:1px solid #999;padding:.25em .4em;vertical-align:top;text-align:left;font-size:9pt}"
    "code{font-size:8pt;overflow-wrap:anywhere}h1{page-break-before:always}svg{max-width:100%}thead{display:table-header-group}"
)


def filled(text: str, tables: Tables, record: str) -> str:
    """A text with its marks replaced by what the tables say. Raises KeyError: a mark that nothing is made for."""
    made = {"release": lambda _: record, "soup": parts.soup_list}

    def put(mark: re.Match[str]) -> str:
        name = mark[1].replace("-", "_")
        return (made.get(name) or vars(parts)[name])(tables)

    return MARK.sub(put, text)


def printable(pages: dict[str, str]) -> str:
    """One HTML page; links between its pages stay within it, others are their words alone."""
    within = [f'<section id="{name}">{_html(text, pages)}</section>' for name, text in pages.items()]
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><title>stimrig: technical file</title>'
    return f"{head}<style>{STYLE}</style>{''.join(within)}</html>\n"


def _html(text: str, pages: dict[str, str]) -> str:
    from markdown_it import MarkdownIt

    def lead(link: re.Match[str]) -> str:
        page = link[2].partition("#")[0].removesuffix(".md")
        return f"[{link[1]}](#{page})" if page in pages else link[1]

    return (
        MarkdownIt("commonmark", {"html": True})
        .enable("table")
        .render(re.sub(r"\[([^\]]+)\]\(([^)\s]+)\)", lead, text))
    )


def write(to: Path, dist: Path | None, tests: Path | None) -> None:
    """Every page, and all of them as one."""
    tables, record = places.read(), release.record(dist, tests)
    pages = {page: filled((SAFETY / f"{page}.md").read_text("utf-8"), tables, record) for page in PAGES}
    to.mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        (to / f"{name}.md").write_text(text, "utf-8")
    (to / "technical-file.html").write_text(printable(pages), "utf-8")
    print(to / "technical-file.html")


def arguments(given: list[str]) -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(prog="python -m deploy.technical_file")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--to", type=Path, default=ROOT / "build" / "technical-file")
    parser.add_argument("--dist", type=Path)
    parser.add_argument("--tests", type=Path)
    parser.add_argument("--sbom", type=Path)
    asked = parser.parse_args(given)
    if asked.dist and not asked.dist.is_dir():
        parser.error(f"--dist {asked.dist}: no folder; name the one with what is released")
    if asked.tests and not asked.tests.is_file():
        parser.error(f"--tests {asked.tests}: no file; name what pytest wrote with --junitxml")
    return asked


def main(given: list[str]) -> int:
    """Check, then write; the exit code."""
    asked = arguments(given)
    from tests.simulator.invariants import INVARIANTS

    listed = {name for name, *_ in sbom.packages()}
    found = checks.faults(places.read(), {one.__name__ for one in INVARIANTS})
    found += sbom.licence_faults(listed, sbom.licences())
    if found:
        print("\n".join(found), file=sys.stderr)
        return 1
    if asked.sbom:
        asked.sbom.parent.mkdir(parents=True, exist_ok=True)
        asked.sbom.write_text(sbom.build(release.version()), "utf-8")
    elif not asked.check:
        write(asked.to, asked.dist, asked.tests)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
