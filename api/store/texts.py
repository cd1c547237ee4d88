"""Texts that every database holds."""

from __future__ import annotations


def storable(text: str) -> str:
    """The text without what PostgreSQL or UTF-8 does not take, so that what somebody sent can be written down."""
    return text.replace("\x00", "\ufffd").encode("utf-8", "replace").decode()
