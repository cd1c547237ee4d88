"""Says in a results file what wrote it, when, and from which commit."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from tests.harness.commit import commit

RESULTS = Path(__file__).parents[1] / "docs" / "results"
"""Folder of the measured figures."""


def written_by(command: str) -> str:
    """The first sentence of a results file: command, date (UTC) and commit."""
    return f"Written by `{command}` on {datetime.now(UTC):%Y-%m-%d}, commit {commit()}. Do not edit."
