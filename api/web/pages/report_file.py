"""Reports as one HTML file that works anywhere, offline, without a script: its charts are pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts, story_charts
from stimrig.api.charts.drawing import Figures
from stimrig.api.models import explanation, stored_model
from stimrig.api.web.pages.environment import HERE, environment

POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'none'; base-uri 'none'"
"""Nothing runs in a report, nothing is loaded, nothing leaves."""


def comparison_html(
    document: dict[str, Any],
    curves: dict[str, Any],
    name: str,
    test: dict[str, Any] | None = None,
    comparison: dict[str, Any] | None = None,
) -> str:
    """Write measurement against model: where it fails, and by how much.

    `document` is a MODEL.json, `curves` as `stimrig.api.jobs.curves.curves` gives them, `name` a file's or a test's,
    `test` as the service shows it, `comparison` as `identify.compare` gives it, cleaned and thinned.
    """
    judged, held = stored_model.quality(document), explanation.held_free(document)
    return _page(
        "report.html",
        held=held,
        title=f"{name}: measurement against model",
        model={**stored_model.figures(document), **judged, "id": document["model_id"], "method": document["method"]},
        effects=[effect["id"] for effect in document.get("effects") or []],
        recruitment=stored_model.recruitment(document),
        dynamics=stored_model.dynamics(document),
        repetition=stored_model.repetition(document),
        test=test,
        figures=Figures(
            model_charts.model_figures(document, curves, comparison)
            | joint_charts.joint_figures(document)
            | diagnosis_charts.free_effects(held)
            | diagnosis_charts.diagnosis_figures(comparison, curves["segments"], None, {}, [])
        ),
        plain=(comparison or {}).get("plain") or [],
        places=diagnosis_charts.places_of(comparison or {}),
        splits=explanation.splits(comparison or {}),
        tests=((comparison or {}).get("tests") or {}).get("tests") or [],
    )


def diagnosis_html(
    diagnosis: dict[str, Any], comparison: dict[str, Any], segments: list[dict[str, Any]], name: str
) -> str:
    """Write what is missing, as the page shows it.

    `diagnosis` is as `stimrig.api.jobs.verbs.diagnosis` gives it, `comparison` of the examined model with the
    record, thinned, `segments` as `stimrig.api.jobs.curves.runs` gives them.
    """
    view = explanation.view(diagnosis, comparison)
    return _page(
        "report_diagnosis.html",
        title=f"{name}: what is missing",
        figures=Figures(
            diagnosis_charts.diagnosis_figures(comparison, segments, view, diagnosis.get("signatures") or {}, [])
        ),
        **missing_parts(view, comparison),
    )


def missing_parts(view: dict[str, Any] | None, comparison: dict[str, Any] | None) -> dict[str, Any]:
    """What `missing.html` shows, on the page and in a file."""
    if view is not None:
        return {"why": view, **{key: view[key] for key in ("places", "splits", "tests")}}
    alone = comparison or {}
    return {
        "why": None, "places": diagnosis_charts.places_of(alone), "splits": explanation.splits(alone), "tests": [],
    }  # fmt: skip


def story_html(
    told: dict[str, Any], before: dict[str, Any], after: dict[str, Any], name: str,
    refused: Sequence[dict[str, Any]] = (), structure: str = "",
) -> str:  # fmt: skip
    """Write the story, as `stimrig.api.models.story.story` gives it.

    `before` and `after` are curves and comparison of the first model and of the last one, `refused` what was tried and
    not added, `structure` what it was begun with.
    """
    figures = story_charts.story_figures(told, before, after)
    shown = {"story": told, "figures": figures, "refused": refused, "structure": structure}
    return _page("report_story.html", title=f"{name}: {told['title']}", name=name, **shown)


def _page(template: str, **values: Any) -> str:
    style = Markup("").join(Markup((HERE / "static" / name).read_text("utf-8")) for name in ("page.css", "lead.css"))
    return environment.get_template(template).render(**values, style=style, policy=POLICY)
