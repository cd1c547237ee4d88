"""Reports as one HTML file that works offline: of a model, and of the story of its improvement."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from stimrig.api.charts import diagnosis_charts, model_charts
from stimrig.api.charts.figure import SHEET, Figures
from stimrig.api.models import explanation, stored_model
from stimrig.api.web.pages.environment import environment

POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'none'; base-uri 'none'"
"""Nothing runs in a report, nothing is loaded, nothing leaves."""
ABSENT: dict[str, Any] = {
    "model": None, "story": None, "why": None, "session": None, "problem": None, "validity": None, "recording": None,
    "summary": None, "warnings": (), "plain": (), "versions": (), "digest": "",
    "footer": "Made by stimrig. This file needs no network.",
}  # fmt: skip
"""What a report need not have."""


def comparison_html(
    document: dict[str, Any],
    curves: dict[str, Any],
    name: str,
    test: dict[str, Any] | None = None,
    comparison: dict[str, Any] | None = None,
) -> str:
    """Write measurement against model: where it fails, and by how much.

    `document`: a MODEL.json; `curves`: as `stimrig.api.jobs.curves.curves` gives them; `name`: of the file or the test;
    `test`: as the service shows it; `comparison`: as `identify.compare` gives it, cleaned and thinned.
    """
    effects = [effect["id"] for effect in document.get("effects") or []]
    model = {**stored_model.figures(document), **stored_model.quality(document)}
    figures = model_charts.model_figures(document, curves, comparison)
    figures |= diagnosis_charts.diagnosis_figures(comparison, curves["segments"], None, {}, [])
    error = missing_parts(None, comparison)
    return write(
        title=f"{name}: measurement against model",
        lead=f"with {', '.join(effects)}" if effects else "",
        model={**model, "id": document["model_id"], "method": document["method"]},
        figures=Figures(figures),
        summary=test and test["summary"],
        plain=(comparison or {}).get("plain") or [],
        **facts(document),
        **{**error, "tests": ((comparison or {}).get("tests") or {}).get("tests") or []},
    )


def facts(document: dict[str, Any]) -> dict[str, Any]:
    """Return what a model's page and its reports say of MODEL.json."""
    return {
        "held": explanation.held_free(document),
        "recruitment": stored_model.recruitment(document),
        "dynamics": stored_model.dynamics(document),
        "repetition": stored_model.repetition(document),
        "validity": stored_model.validity(document),
    }


def missing_parts(view: dict[str, Any] | None, comparison: dict[str, Any] | None) -> dict[str, Any]:
    """Return `why` (the view of a diagnosis, if there is one), and `places`, `splits` and `tests` of the error."""
    if view is not None:
        return {"why": view, **{key: view[key] for key in ("places", "splits", "tests")}}
    alone = comparison or {}
    return {
        "why": None, "places": diagnosis_charts.places_of(alone), "splits": explanation.splits(alone), "tests": [],
    }  # fmt: skip


def story_html(
    story: dict[str, Any], before: dict[str, Any], after: dict[str, Any], name: str, structure: str = ""
) -> str:
    """Write the story of a model.

    `story`: as `stimrig.api.models.story.story` gives it; `before`, `after`: curves and comparison of the first model
    and of the last one; `name`: of the record; `structure`: of the first model.
    """
    begun = f" · begun with {structure}" if structure else ""
    lead = f"{name} · noise {story['noise_sd_nm'] or 0.0:.4f} N·m{begun}"
    figures = Figures(diagnosis_charts.story_figures(story, before, after))
    return write(title=story["title"], lead=lead, story=story, figures=figures)


def write(**values: Any) -> str:
    """Write a report of what the template takes."""
    style = Markup(SHEET.read_text("utf-8"))
    return environment.get_template("report.html").render(**ABSENT | values, style=style, policy=POLICY)
