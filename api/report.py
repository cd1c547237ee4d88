"""Reports as one HTML file that works anywhere, offline: charts, figures and plotly inside."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from api import reading
from api.pages import charts
from api.pages.render import HERE, environment
from api.pages.static import plotly_path
from api.verdict import figures, quality


def comparison_html(
    document: dict[str, Any], curves: dict[str, Any], name: str, test: dict[str, Any] | None = None
) -> str:
    """Measurement against model.

    Parameters
    ----------
    document : dict
        MODEL.json.
    curves : dict
        As `api.jobs.curves` gives them.
    name : str
        What was measured: a file's or a test's name.
    test : dict or None
        The test as the service shows it.
    """
    fit = figures(document)
    return _page(
        "report.html",
        title=f"{name}: measurement against model",
        model={**fit, **quality(fit), "id": document["model_id"], "method": document["method"]},
        effects=[effect["id"] for effect in document.get("effects") or []],
        recruitment=reading.recruitment(document),
        dynamics=reading.dynamics(document),
        test=test,
        figures=charts.of_model(document, curves),
    )


def improvement_html(found: dict[str, Any], name: str) -> str:
    """Effects added one by one, and the falling error."""
    return _page(
        "report_improve.html", title=f"{name}: what was missing", found=found, figures={"steps": charts.steps(found)}
    )


def _page(template: str, **values: Any) -> str:
    inside = {
        "style": Markup((HERE / "static" / "page.css").read_text("utf-8")),
        "plotly": Markup(plotly_path().read_text("utf-8").replace("</script", "<\\/script")),
        "script": Markup((HERE / "static" / "model.js").read_text("utf-8")),
    }
    return environment.get_template(template).render(**values, **inside)
