"""Figures for programs and notebooks: those of the pages."""

from __future__ import annotations

from typing import Any

from stimrig.api.charts import diagnosis_charts, model_charts
from stimrig.api.charts.figure import Figure
from stimrig.api.jobs.curves import curves, rounded, runs
from stimrig.api.models import explanation
from stimrig.identify import BadRequest, Comparison, Diagnosis, Improvement, Model, Record, compare


def plot(what: Any, record: Record | None = None) -> Figure:
    """Draw a model beside its measurement, a comparison's residual, how the error fell, or what a free effect does.

    Parameters
    ----------
    what : Model, Comparison, Improvement or Diagnosis
        Of a model without a record the recruitment curve is drawn; of a diagnosis the first free effect.
    record : Record, optional
        The measurement.

    Returns
    -------
    Figure
        A notebook shows it; `save` writes it as .svg, .pdf or .png.

    Raises
    ------
    BadRequest
        It is none of these, or a diagnosis without a free effect.
    """
    if isinstance(what, Model):
        if record is None:
            return model_charts.recruitment(what.to_dict())
        series = rounded(compare(what, record).to_dict())["series"]
        return model_charts.measurement(curves(what, record), what.fit.get("noise_sd_nm"), series)
    if isinstance(what, Comparison):
        result = what.to_dict()
        segments = runs(result["series"]["segment"], result["series"]["time_s"])
        return diagnosis_charts.residual(rounded(result), segments, diagnosis_charts.places_of(result))
    if isinstance(what, Improvement):
        return diagnosis_charts.falling(explanation.step_versions({**what.to_dict(), "models": []}))
    if isinstance(what, Diagnosis) and what.free:
        return model_charts.free_effect(dict(what.free[0]))
    message = (
        "plot takes a model and its record, a comparison, what improve found, or a diagnosis with a free effect: "
        "plot(model, record)"
    )
    raise BadRequest(message, place="plot")
