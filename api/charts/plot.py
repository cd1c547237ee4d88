"""Figures for programs and notebooks: the page's figures as plotly objects."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go

from stimrig.api.charts import diagnosis_charts, model_charts
from stimrig.api.charts.figure import CONFIG, Figure, in_light
from stimrig.api.jobs.curves import curves, rounded, runs
from stimrig.api.models import explanation
from stimrig.identify import BadRequest, Comparison, Diagnosis, Improvement, Model, Record, compare

CURVES_DOMAIN, SIDE_DOMAIN = [0.0, 0.66], [0.74, 1.0]
"""Widths of the measurement and of the recruitment curve beside it."""


def _local(options: dict[str, Any]) -> dict[str, Any]:
    return {**options, "config": {**(options.get("config") or {}), **CONFIG}}


class LocalFigure(go.Figure):
    """A plotly figure without a button to upload it, whose HTML loads nothing from elsewhere."""

    def show(self, *args: Any, **options: Any) -> None:
        """Show it."""
        super().show(*args, **_local(options))

    def to_html(self, *args: Any, **options: Any) -> str:
        """Return it as HTML."""
        return super().to_html(*args, **_local(options))

    def write_html(self, *args: Any, **options: Any) -> None:
        """Write it into an HTML file."""
        super().write_html(*args, **_local(options))

    def _repr_html_(self) -> str:
        bundle = self._repr_mimebundle_()
        return bundle.get("text/html") or self.to_html(full_html=False, include_plotlyjs=True)

    def _repr_mimebundle_(self, *args: Any, **options: Any) -> Any:
        return super()._repr_mimebundle_(*args, **_local(options))

    def _ipython_display_(self) -> None:
        import plotly.io as pio

        if pio.renderers.render_on_display and pio.renderers.default:
            self.show()
        else:
            print(repr(self))


def plot(what: Any, record: Record | None = None) -> LocalFigure:
    """Draw a model beside its measurement, a comparison's residual, how the error fell, or what a free effect does.

    Parameters
    ----------
    what : Model, Comparison, Improvement or Diagnosis
        A model needs a record; of a diagnosis the first free effect is drawn.
    record : Record, optional
        The measurement.

    Returns
    -------
    LocalFigure
        A `plotly.graph_objects.Figure` without a button to upload it.

    Raises
    ------
    BadRequest
        It is none of these, a model without a record, or a diagnosis without a free effect.
    """
    if isinstance(what, Model) and record is not None:
        figure = _model(what, record)
    elif isinstance(what, Comparison):
        result = what.to_dict()
        segments = runs(result["series"]["segment"], result["series"]["time_s"])
        figure = diagnosis_charts.residual(rounded(result), segments, diagnosis_charts.places_of(result))
    elif isinstance(what, Improvement):
        figure = diagnosis_charts.falling(explanation.step_versions({**what.to_dict(), "models": []}))
    elif isinstance(what, Diagnosis) and what.free:
        figure = model_charts.free_effect(dict(what.free[0]))
    else:
        message = (
            "plot takes a model and its record, a comparison, what improve found, or a diagnosis with a free effect: "
            "plot(model, record)"
        )
        raise BadRequest(message, place="plot")
    return LocalFigure(in_light(figure))


def _model(model: Model, record: Record) -> Figure:
    """Return measurement and model with residual and pulse widths, and the recruitment curve beside them."""
    series = rounded(compare(model, record).to_dict())["series"]
    large = model_charts.measurement(curves(model, record), model.fit.get("noise_sd_nm"), series)
    side = model_charts.recruitment(model.to_dict())
    large["data"] += [{**trace, "xaxis": "x2", "yaxis": "y4", "showlegend": False} for trace in side["data"]]
    large["layout"]["xaxis"]["domain"] = CURVES_DOMAIN
    large["layout"]["xaxis2"] = {**side["layout"]["xaxis"], "domain": SIDE_DOMAIN, "anchor": "y4"}
    large["layout"]["yaxis4"] = {**side["layout"]["yaxis"], "anchor": "x2"}
    return large
