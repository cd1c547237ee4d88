"""Measured records that others published without a licence to hand them on: read from a local copy, never committed.

A copy of each repository, at the commit named here, lies in a folder of the repository's name; the folder above is
given by `--data`, or by the environment variable STIMRIG_MEASURED_DIR. What is not there is told as absent.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "STIMRIG_MEASURED_DIR"


class Absent(Exception):
    """A local copy that is not at hand."""


@dataclass(frozen=True)
class Place:
    """A file or a folder of a public repository at a commit."""

    repository: str
    commit: str
    file: str

    def local(self, data: Path | None = None) -> Path:
        """Where its local copy is.

        Raises
        ------
        Absent
            There is none; with what to copy, and where to.
        """
        given = data or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
        path = (given or Path(VARIABLE)) / self.repository.partition("/")[2] / self.file
        if given is None or not path.exists():
            raise Absent(f"absent: {self.repository} at {self.commit}, {self.file}, is not at {path}")
        return path
