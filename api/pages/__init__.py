"""The page: server-rendered, offline, plain forms; one file a subject, each with a `router`."""

from __future__ import annotations

from fastapi import APIRouter

from api.pages import (
    administration_view,
    calibration_view,
    compare_view,
    forms,
    home,
    model_view,
    report_view,
    static,
    views,
)


def routers() -> list[APIRouter]:
    """The routers of the page."""
    subjects = (
        home, views, model_view, report_view, compare_view, calibration_view, administration_view, forms, static,
    )  # fmt: skip
    return [subject.router for subject in subjects]
