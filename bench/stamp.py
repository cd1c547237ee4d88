"""Says in a results file what wrote it, when, and from which commit."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path

RESULTS = Path(__file__).parents[1] / "docs" / "results"
"""Folder of the measured figures."""


def commit() -> str:
    """Short hash of the tree, with `-dirty` where files differ from it; "not known" outside a git checkout."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    done = subprocess.run(command, cwd=RESULTS.parents[1], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "not known"


def written_by(command: str) -> str:
    """The first sentence of a results file: command, date (UTC) and commit."""
    return f"Written by `{command}` on {datetime.now(UTC):%Y-%m-%d}, commit {commit()}. Do not edit."
