"""The release record: what was released, of what commit, with which hashes, and which tests ran."""

from __future__ import annotations

import hashlib
import subprocess
import tomllib
from datetime import date
from pathlib import Path
from xml.etree import ElementTree

from deploy import soup
from deploy.technical_file.parts import table
from deploy.technical_file.places import ROOT

OPEN = "**open: filled by who releases** (`make technical-file DIST=… TESTS=…`)"


def version() -> str:
    """As pyproject.toml says."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def record(dist: Path | None, tests: Path | None) -> str:
    """The record as Markdown; what is not given stays open, in words.

    `dist`: the folder of what is released. `tests`: what pytest wrote with --junitxml.
    Raises OSError, ElementTree.ParseError: one of them cannot be read.
    """
    looked = [note["looked_at"] for note in soup.notes()["anomalies"].values()]
    rows = [
        ("Product, version", f"stimrig {version()}"),
        ("Commit", _commit()),
        ("Files, SHA-256", OPEN if dist is None else _hashes(dist)),
        ("Tests", OPEN if tests is None else _ran(tests)),
        ("Locks, SHA-256", "<br>".join(_sum(lock) for lock in (soup.LOCK, soup.EXTRAS))),
        ("Known anomalies of software of others", f"looked at from {min(looked)} to {max(looked)}"),
        ("Known anomalies of our own", "the list of what remains open, below the hazards"),
        ("Known vulnerabilities", "`make audit`, on the day of the release; its answer goes here: **open**"),
        ("Released by, date", "**open**"),
    ]
    return table(("", ""), rows)


def _commit() -> str:
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=40"], cwd=ROOT, capture_output=True, text=True
    )
    return f"`{done.stdout.strip()}`" if done.returncode == 0 else OPEN


def _hashes(folder: Path) -> str:
    found = sorted(path for path in folder.iterdir() if path.is_file())
    return "<br>".join(map(_sum, found)) or OPEN


def _sum(path: Path) -> str:
    return f"`{path.name}` {hashlib.sha256(path.read_bytes()).hexdigest()}"


def _ran(report: Path) -> str:
    """Counts of a junit file, and the day on which it was written."""
    suites = list(ElementTree.parse(report).iter("testsuite"))
    count = {key: sum(int(suite.get(key, 0)) for suite in suites) for key in ("tests", "failures", "errors", "skipped")}
    day = date.fromtimestamp(report.stat().st_mtime)
    return f"{day}: " + ", ".join(f"{number} {name}" for name, number in count.items())
