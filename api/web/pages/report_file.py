"""Reports as one HTML file that works anywhere, offline: charts, figures and plotly inside."""

from __future__ import annotations

import base64
import hashlib
from typing import Any

from markupsafe import Markup

from stimrig.api.charts import diagnosis_charts, joint_charts, model_charts
from stimrig.api.models import explanation, stored_model
from stimrig.api.web.pages.environment import HERE, environment
from stimrig.api.web.pages.static import packaged
from stimrig.identify.yardstick import repetition_sentences


def comparison_html(
    document: dict[str, Any],
    curves: dict[str, Any],
    name: str,
    test: dict[str, Any] | None = None,
    comparison: dict[str, Any] | None = None,
) -> str:
    """Measurement against model: where it fails, and by how much.

    Parameters
    ----------
    document : dict
        MODEL.json.
    curves : dict
        As `stimrig.api.workers.curves.curves` gives them.
    name : str
        What was measured: a file's or a test's name.
    test : dict or None
        The test as the service shows it.
    comparison : dict or None
        As `identify.compare` gives it, cleaned and thinned.
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
        figures={
            **model_charts.model_figures(document, curves, comparison),
            **joint_charts.joint_figures(document),
            **diagnosis_charts.pictures(held),
            **diagnosis_charts.diagnosis_figures(comparison, curves["segments"], None, {}, []),
        },
        plain=(comparison or {}).get("plain") or [],
        places=diagnosis_charts.places_of(comparison or {}),
        splits=explanation.splits(comparison),
        tests=((comparison or {}).get("tests") or {}).get("tests") or [],
    )


def improvement_html(
    found: dict[str, Any],
    name: str,
    diagnosis: dict[str, Any] | None = None,
    before: dict[str, Any] | None = None,
    after: dict[str, Any] | None = None,
    segments: list[dict[str, Any]] | None = None,
) -> str:
    """Effects added one by one, what each is, and the falling error.

    Parameters
    ----------
    found : dict
        As `stimrig.identify.diagnosis.improvement` gives it.
    name : str
        The record's.
    diagnosis : dict or None
        As `stimrig.api.workers.verbs.diagnosis` gives it: explanations, parameters, signatures.
    before, after : dict or None
        Comparisons of the first model and of the last one with the record.
    segments : list of dict or None
        The record's, as `stimrig.api.workers.curves.runs` gives them.
    """
    rows = explanation.step_versions(found)
    view = explanation.view(diagnosis, before, []) if diagnosis else None
    drawn = diagnosis_charts.diagnosis_figures(
        before, segments or [], view, (diagnosis or {}).get("signatures") or {}, rows
    )
    if after:
        places = diagnosis_charts.places_of(after)
        shown = places if explanation.noisy(after) else []
        drawn["residual-after"] = diagnosis_charts.residual(after, segments or [], shown)
    return _page(
        "report_improve.html",
        title=f"{name}: what was missing",
        found=found,
        rows=rows,
        why=view,
        figures=drawn,
        repetition=repetition_sentences(found["steps"][-1]),
    )


def _page(template: str, **values: Any) -> str:
    inside = {
        "style": Markup((HERE / "static" / "page.css").read_text("utf-8")),
        "plotly": Markup(packaged("plotly.min.js").read_text("utf-8").replace("</script", "<\\/script")),
        "script": Markup((HERE / "static" / "charts.js").read_text("utf-8")),
    }
    policy = report_policy(inside["plotly"], inside["script"])
    return environment.get_template(template).render(**values, **inside, policy=policy)


def report_policy(*scripts: str) -> str:
    """The Content-Security-Policy of a report: these scripts run, nothing is loaded, nothing leaves."""
    hashes = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    allowed = " ".join(f"'sha256-{value}'" for value in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data: blob:; "
        "connect-src 'none'; form-action 'none'; base-uri 'none'"
    )
