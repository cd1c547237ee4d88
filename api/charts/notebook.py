"""For notebooks: everything of `identify` in one place, and `plot`. Needs no service.

from api.charts.notebook import compare, diagnose, fit, improve, plot, read
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from identify import Improvement, Model, compare, diagnose, fit, improve, predict, read

if TYPE_CHECKING:
    from api.charts.local_figure import LocalFigure
    from identify import Record

__all__ = ["compare", "diagnose", "fit", "improve", "plot", "predict", "read"]

MEASURED, MODEL, STIMULUS = "#a9b4be", "#0b6b75", "#b4690e"
POINTS = 4000


def plot(what: Model | Improvement, record: Record | None = None) -> LocalFigure:
    """Draw a model beside its measurement, or how the error fell.

    Parameters
    ----------
    what : Model or Improvement
        A model; or what `improve` found.
    record : Record, optional
        The measurement; needed with a model.

    Returns
    -------
    LocalFigure
        A `plotly.graph_objects.Figure` without a button to upload it.

    Raises
    ------
    TypeError
        Neither a model with a record, nor what `improve` found.
    """
    if isinstance(what, Improvement):
        return _errors(what)
    if record is None or not isinstance(what, Model):
        raise TypeError("plot(model, record), or plot(improve(record))")
    return _comparison(what, record)


def _comparison(model: Model, record: Record) -> LocalFigure:
    import numpy as np
    from plotly.subplots import make_subplots

    from api.charts.local_figure import LocalFigure

    pick = slice(None, None, max(1, -(-record.time_s.size // POINTS)))
    predicted, time_s = np.asarray(predict(model, record))[pick], record.time_s[pick]
    torque, (width_us, torque_nm) = record.torque_nm[pick], model.recruitment.table()
    grid = [[{}, {"rowspan": 3}], [{}, None], [{}, None]]
    figure = make_subplots(
        3, 2, specs=grid, shared_xaxes=True, column_widths=[0.68, 0.32], row_heights=[0.5, 0.25, 0.25]
    )
    rows = [
        (1, torque, "measured", MEASURED), (1, predicted, "model", MODEL),
        (2, torque - predicted, "measured − model", "#1b2733"),
        (3, record.pulse_width_us[pick], "pulse width", STIMULUS),
    ]  # fmt: skip
    for row, values, name, colour in rows:
        figure.add_scatter(x=time_s, y=values, name=name, line_color=colour, row=row, col=1)
    figure.add_scatter(x=width_us, y=torque_nm, name="f", line_color=MODEL, row=1, col=2)
    for row, title in enumerate(("Torque (N·m)", "Residual (N·m)", "Pulse width (µs)"), start=1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="Time (s)", row=3, col=1)
    figure.update_xaxes(title_text="Pulse width (µs)", row=1, col=2)
    figure.update_yaxes(title_text="Recruitment (N·m)", row=1, col=2)
    return LocalFigure(figure.update_layout(template="plotly_white", height=600, showlegend=False))


def _errors(found: Improvement) -> LocalFigure:
    from api.charts.local_figure import LocalFigure

    names = [step["added"] or "base model" for step in found.steps]
    figure = LocalFigure()
    for key, name, colour in (("rms_nm", "fitted rows", MEASURED), ("held_out_rms_nm", "held out", MODEL)):
        values = [step[key] for step in found.steps]
        figure.add_scatter(x=names, y=values, name=name, mode="lines+markers", line_color=colour)
    figure.add_hline(found.noise_sd_nm, line_dash="dash", line_color=STIMULUS, annotation_text="noise")
    figure.update_xaxes(title_text="Effect added", type="category")
    figure.update_yaxes(title_text="RMS error (N·m)", rangemode="tozero")
    figure.update_layout(template="plotly_white", height=420)
    return figure
