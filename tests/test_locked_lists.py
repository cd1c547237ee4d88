"""The locked lists of packages: everything pinned by a hash, no host named, nothing that hides a package of ours."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

LISTS = sorted((Path(__file__).parents[1] / "requirements").glob("*.txt"))


@pytest.mark.parametrize("path", LISTS, ids=lambda path: path.name)
def test_each_package_is_pinned_by_a_hash_and_no_host_is_named(path: Path) -> None:
    text = path.read_text()
    pins = re.findall(r"^([a-zA-Z0-9._-]+)(?:\[.*\])?==", text, re.M)
    assert pins and (path.name == "docs.txt" or len(pins) <= text.count("--hash=sha256:"))  # the site is not shipped
    assert "://" not in text and not re.search(r"^\s*--(extra-)?index|^\s*-i ", text, re.M)
    # a package of PyPI named `identify` (a dependency of pre-commit) would hide ours
    assert not {"identify", "rig", "api", "hardware-sim"} & set(pins)
