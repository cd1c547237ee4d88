"""Version of the software."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def software_version() -> str:
    """The installed distribution's version."""
    try:
        return version("stimrig")
    except PackageNotFoundError:
        return "0"
