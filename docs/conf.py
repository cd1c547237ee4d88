"""The site of the documentation: `make docs` writes it to build/site, without a warning and without the network.

The source folder is the whole checkout, of which only the pages are taken: so each link between pages is the same here
and in the repository.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
os.environ |= {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
"""Of the notebooks' kernels: they show this checkout, whatever is installed."""

import generators  # noqa: E402
import numpydoc.xref  # noqa: E402

from stimrig.api.version import software_version  # noqa: E402

project = "stimrig"
author = "The stimrig developers"
copyright = author
version = release = software_version()
root_doc = "docs/index"
language = "en"

extensions = ["sphinx.ext.autodoc", "numpydoc", "myst_nb"]
include_patterns = ["*.md", "docs/**", "tests/README.md", "tests/frozen/README.md"]
TOP = {"docs", "tests"} | {path.name for path in ROOT.glob("*.md")}
exclude_patterns = [*sorted({path.name for path in ROOT.iterdir()} - TOP), "**/.*"]

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = os.environ.get("NOTEBOOKS", "force")
nb_execution_raise_on_error = True
nb_execution_timeout = 1500  # s, for a cell: the machine may be busy
nb_merge_streams = True
nb_output_stderr = "remove"  # progress bars
nb_mime_priority_overrides = [("*", "text/html", 5), ("*", "image/svg+xml", 6)]
nb_ipywidgets_js = {}  # they would come from another host

autodoc_typehints = "none"  # numpydoc's sections say the types
autodoc_member_order = "bysource"
numpydoc.xref.DEFAULT_LINKS.clear()  # they lead to other hosts
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_aliases = generators.links()
numpydoc_xref_ignore = "all"

html_theme = "pydata_sphinx_theme"
html_title = f"stimrig {release}"
html_sourcelink_suffix = ""
html_copy_source = False
html_show_sphinx = False
html_extra_path = ["site_root"]
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
}

LINK = re.compile(r"(?<!!)\[([^\]\n]+)\]\(([^)\s:#]+?)/?\)")


def prepare(app: Any, docname: str, source: list[str]) -> None:
    """Fill in what a page asks to be made, and make of a link to a folder one to its README, or only its words."""
    page = Path(app.srcdir, docname).parent

    def of_folder(match: re.Match[str]) -> str:
        folder = page / match[2]
        if not folder.is_dir():
            return match[0]
        inside = (folder / "README.md").exists() and (ROOT / "docs") in folder.resolve().parents
        return f"[{match[1]}]({match[2]}/README.md)" if inside else match[1]

    text = re.sub(r"<!-- made: ([a-z_]+) -->", lambda match: getattr(generators, match[1])(), source[0])
    source[0] = LINK.sub(of_folder, text)


def tell_fields(_app: Any, what: str, _name: str, thing: Any, _options: Any, lines: list[str]) -> None:
    """Give a class its fields, from what stands beside them in the code."""
    if what in ("class", "exception"):
        lines += generators.attributes(thing)


def list_outside(app: Any, failed: Exception | None) -> None:
    """Write every address of another host that a page links to into one file, for who wants to try them."""
    addresses: set[str] = set()
    for page in Path(app.outdir).rglob("*.html") if failed is None else ():
        addresses |= set(re.findall(r'href="(https?://[^"#]+)', page.read_text("utf-8")))
    Path(app.outdir, "outside.txt").write_text("\n".join(sorted(addresses)) + "\n")


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("build-finished", list_outside)
    app.connect("source-read", prepare)
    app.connect("autodoc-process-docstring", tell_fields, priority=400)  # before numpydoc
