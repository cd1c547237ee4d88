"""Says in a results file what wrote it, when, and from which commit."""

from __future__ import annotations

import subprocess
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
"""Folder of the measured figures."""


def written_by(command: str) -> str:
    """The first sentence of a results file: command, date (UTC) and commit."""
    git = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    commit = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip() or "not known"
    return f"Written by `{command}` on {datetime.now(UTC):%Y-%m-%d}, commit {commit}. Do not edit."
