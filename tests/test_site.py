"""The site of the docs: no warning, whole without a network; docstrings, notebooks, files of the project, the paper."""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from html import unescape
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote

import pytest
from numpydoc.docscrape import FunctionDoc

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOTEBOOKS = [page for page in sorted((DOCS / "tutorials").glob("*.md")) if "mystnb" in page.read_text("utf-8")]


@cache
def generators() -> ModuleType:
    """docs/generators.py, which no package holds."""
    spec = importlib.util.spec_from_file_location("generators", DOCS / "generators.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---- pages


def listed(page: Path) -> Iterator[Path]:
    """The pages in the toctrees of a page."""
    for block in re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        for entry in (line for line in block.splitlines() if line and line[0] != ":"):
            place = (page.parent / entry).resolve()
            found = sorted(place.parent.glob(place.name + ".md"))
            assert found, f"{page.relative_to(ROOT)}: there is no page {entry}"
            yield from found


def test_every_page_is_in_one_list_of_the_site() -> None:
    entries, new = [DOCS / "index.md"], [DOCS / "index.md"]
    while new:
        new = [below for page in new for below in listed(page)]
        entries += new
    assert len(entries) == len(set(entries)), "a page is listed twice"
    pages = set(DOCS.rglob("*.md")) | set(ROOT.glob("*.md"))
    missing = sorted(str(page.relative_to(ROOT)) for page in pages - set(entries))
    assert missing == [], "list it in the toctree of docs/how-to/index.md, reference/, explanation/ or tutorials/"


# ---- docstrings


def lacking(name: str, one: Any) -> str:
    """What the docstring of a function, a property or a class lacks; empty: nothing."""
    if not inspect.getdoc(one) or (inspect.isclass(one) and str(one.__doc__).startswith(f"{one.__name__}(")):
        return f"{name}: no docstring"
    if not inspect.isfunction(one):
        return ""
    told, signature = FunctionDoc(one), inspect.signature(one)
    named = {part.strip().lstrip("*") for row in told["Parameters"] for part in row.name.split(",")}
    asked = set(signature.parameters) - {"self", "cls"}
    gives = str(signature.return_annotation) not in ("None", str(inspect.Signature.empty))
    parts = [f"Parameters of {word}" for word in sorted(asked ^ named)]
    parts += ["Returns"] if gives and not told["Returns"] and not told["Yields"] else []
    return f"{name}: {', '.join(parts)}" if parts else ""


def public() -> dict[str, Any]:
    """Every public name, and each public method and property of those that are classes."""
    made, found = generators(), {}
    for name, one in made.public().items():
        found[name] = one
        if inspect.isclass(one):
            found |= {f"{name}.{word}": method for word, method in made.members(one).items()}
    return found


def test_everything_public_has_a_docstring_with_its_sections() -> None:
    names = public()
    assert len(names) > 250 and {"stimrig.fit", "stimrig.Client.stop", "stimrig.effects", "stimrig.cohort.fit"} <= set(
        names
    )
    assert [told for name, one in names.items() if (told := lacking(name, one))] == []


def test_each_field_of_a_public_class_is_explained() -> None:
    made, names, bare = generators(), 0, []
    for name, one in made.public().items():
        rows = made.attributes(one)[3:] if inspect.isclass(one) else []
        for row, below in pairwise([*rows, ""]):
            if row and row[0] != " ":
                names += 1
                bare += [] if below.startswith("    ") else [f"{name}: {row}"]
    assert names > 200
    assert bare == []


def test_a_docstring_that_lacks_something_is_noticed() -> None:
    def some(width_us: float) -> float:
        """Told in a line."""
        return width_us

    assert lacking("some", some) == "some: Parameters of width_us, Returns"
    some.__doc__ = None
    assert lacking("some", some) == "some: no docstring"


# ---- the built site


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_site_is_built_without_a_warning_and_is_whole(tmp_path: Path) -> None:
    """By the command of `make docs`, notebooks included; in one test, since it takes a minute and a half."""
    site = built(tmp_path)
    links_lead_somewhere(site)
    nothing_is_loaded_from_another_host(site)
    it_can_be_searched(site)
    notebooks_were_run(site)
    the_reference_is_whole(site)


def built(folder: Path) -> Path:
    """The site, in another folder."""
    (line,) = re.findall(r"^\t@(\$\(BIN\)/python -m sphinx .*)$", (ROOT / "Makefile").read_text(), re.M)
    command = shlex.split(line.replace("$(BIN)/python", sys.executable).replace("build/", f"{folder}/"))
    assert {"-W", "-n", "--keep-going"} <= set(command)
    kept = {name: value for name, value in os.environ.items() if name != "NOTEBOOKS"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=kept)
    told = "\n".join(line for line in done.stderr.splitlines() if "IPKernelApp" not in line)
    assert (done.returncode, "WARNING" in told) == (0, False), told
    return folder / "site"


def links_lead_somewhere(site: Path) -> None:
    pages = {page: page.read_text("utf-8") for page in site.rglob("*.html")}
    anchors = {page.resolve(): set(re.findall(r'\bid="([^"]+)"', text)) for page, text in pages.items()}
    dead, count = [], 0
    for page, text in pages.items():
        for link in map(unescape, re.findall(r'<a\b[^>]*\bhref="([^"]*)"', text)):
            name, _, anchor = link.partition("#")
            if "://" in link:
                continue
            count += 1
            target = (page.parent / unquote(name)).resolve() if name else page.resolve()
            if not target.is_file() or (anchor and target in anchors and unquote(anchor) not in anchors[target]):
                dead.append(f"{page.relative_to(site)}: {link}")
    assert count > 1000
    assert dead == []
    assert (site / "outside.txt").read_text().startswith("http")


def nothing_is_loaded_from_another_host(site: Path) -> None:
    loads = re.compile(
        r"""<(?:script|img|iframe|source|video|audio|embed|object)\b[^>]*?\b(?:src|data)="(?:https?:)?//"""
        r"""|<link\b(?![^>]*rel="(?:canonical|license)")[^>]*?\bhref="(?:https?:)?//"""
        r"""|requirejs|@import\s+url\(["']?https?:|url\(["']?(?:https?:)?//"""
    )
    assert loads.search('<script src="https://cdn.example/x.js">')
    files = [*site.rglob("*.html"), *site.rglob("*.css")]
    assert [str(file.relative_to(site)) for file in files if loads.search(file.read_text("utf-8"))] == []


def it_can_be_searched(site: Path) -> None:
    index = (site / "searchindex.js").read_text("utf-8")
    assert all(word in index for word in ("hysteresi", "recruit", "docs/reference/python", "docs/tutorials/table1"))
    assert 'src="_static/searchtools.js' in (site / "search.html").read_text("utf-8")


def notebooks_were_run(site: Path) -> None:
    for notebook in NOTEBOOKS:
        page = (site / notebook.relative_to(ROOT)).with_suffix(".html").read_text("utf-8")
        assert page.count("cell_output") > 2 and ".svg" in page, notebook.name


def the_reference_is_whole(site: Path) -> None:
    shown = "".join(
        (site / "docs" / "reference" / f"{name}.html").read_text("utf-8") for name in ("python", "identify")
    )
    anchors = set(re.findall(r'\bid="([^"]+)"', shown))
    assert [name for name in public() if name not in anchors] == []
    rest = (site / "docs" / "reference" / "rest.html").read_text("utf-8")
    assert all(f" {path}<" in rest for path in generators().document()["paths"])
    verbs = (site / "docs" / "reference" / "command-line.html").read_text("utf-8")
    assert "Usage: stimrig fit" in verbs and "Usage: stimrig cohort diagnose" in verbs


def test_notebooks_are_small_and_name_the_units_of_their_axes() -> None:
    assert len(NOTEBOOKS) >= 5
    for notebook in NOTEBOOKS:
        text = notebook.read_text("utf-8")
        assert len(text) < 8000 and "import stimrig" in text, notebook.name
        labels = re.findall(r'set_[xy]label\("([^"]*)"\)', text)
        assert len(labels) >= 2 and all(re.search(r"\(.+\)", label) for label in labels), (notebook.name, labels)


# ---- files of the project, and the paper


CHANGES = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_the_changelog_has_its_form() -> None:
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    heads = re.findall(r"^## \[(.+?)\](?: - (\d{4}-\d{2}-\d{2}))?$", text, re.M)
    assert heads[0] == ("Unreleased", "") and ("1.0.0", "2026-11-29") in heads
    dates = [date for _, date in heads[1:]]
    assert all(dates) and dates == sorted(dates, reverse=True)
    assert set(re.findall(r"^### (.+)$", text, re.M)) <= CHANGES


def test_who_may_be_told_of_a_fault_is_said_without_an_address_that_is_made_up() -> None:
    text = (ROOT / "SECURITY.md").read_text("utf-8")
    assert not re.search(r"\S+@\S+\.\w+", text)
    assert all(word in text for word in ("private advisory", "working days", "safety", "CHANGELOG.md"))
    assert "SECURITY.md" in (ROOT / "CODE_OF_CONDUCT.md").read_text("utf-8")


SECTIONS = [
    "Summary", "Statement of need", "State of the field", "Software design", "Research impact statement",
    "AI usage disclosure", "Acknowledgements", "References",
]  # fmt: skip


def test_the_paper_has_the_form_of_joss() -> None:
    text = (DOCS / "paper" / "paper.md").read_text("utf-8")
    _, head, body = text.split("---\n", 2)
    assert all(
        f"\n{key}:" in f"\n{head}" for key in ("title", "tags", "authors", "affiliations", "date", "bibliography")
    )
    assert re.findall(r"^# (.+)$", body, re.M) == SECTIONS
    words = len(re.sub(r"<!--.*?-->|^#.*$", "", body, flags=re.M).split())
    assert 750 <= words <= 1750, words
    known = re.findall(r"^@\w+\{(\w+),", (DOCS / "paper" / "paper.bib").read_text("utf-8"), re.M)
    assert set(re.findall(r"@(\w+)", body)) == set(known) and len(known) == len(set(known))
    figures = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", body)
    assert figures
    for caption, place in figures:
        module = re.search(r"`python -m ([\w.]+)", caption)
        assert (DOCS / "paper" / place).is_file() and module and importlib.util.find_spec(module[1]), caption
