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
    participant_view,
    questions_view,
    report_view,
    rig_view,
    static,
    stopped_view,
    views,
)


def routers() -> list[APIRouter]:
    """The routers of the page."""
    subjects = (
        home, rig_view, views, participant_view, questions_view, model_view, report_view, compare_view,
        calibration_view, administration_view, forms, static, stopped_view,
    )  # fmt: skip
    return [subject.router for subject in subjects]
