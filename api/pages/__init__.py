"""The page: server-rendered, offline, plain forms; one file a subject, each with a `router`."""

from __future__ import annotations

from fastapi import APIRouter

from api.pages import forms, home, static, views


def routers() -> list[APIRouter]:
    """The routers of the page."""
    return [home.router, views.router, forms.router, static.router]
