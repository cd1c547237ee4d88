"""Version of the software."""

from __future__ import annotations

from importlib.metadata import version


def software_version() -> str:
    """The installed distribution's version."""
    return version("stimrig")
