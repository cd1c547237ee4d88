"""A plotly figure for notebooks that keeps to `CHART_CONFIG`, however it is shown or saved."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go

from stimrig.api.charts.config import CHART_CONFIG


class LocalFigure(go.Figure):
    """A figure that has no button to upload it, and whose HTML loads nothing from elsewhere."""

    def show(self, *args: Any, config: dict[str, Any] | None = None, **kwargs: Any) -> None:
        """Show it."""
        super().show(*args, config=_with(config), **kwargs)

    def to_html(self, *args: Any, config: dict[str, Any] | None = None, **kwargs: Any) -> str:
        """As HTML."""
        return super().to_html(*args, config=_with(config), **kwargs)

    def write_html(self, *args: Any, config: dict[str, Any] | None = None, **kwargs: Any) -> None:
        """Into an HTML file."""
        super().write_html(*args, config=_with(config), **kwargs)

    def _repr_html_(self) -> str:
        bundle = self._repr_mimebundle_()
        return bundle.get("text/html") or self.to_html(full_html=False, include_plotlyjs=True)

    def _repr_mimebundle_(self, *args: Any, **kwargs: Any) -> Any:
        return super()._repr_mimebundle_(*args, config=_with(None), **kwargs)

    def _ipython_display_(self) -> None:
        import plotly.io as pio

        if pio.renderers.render_on_display and pio.renderers.default:
            self.show()
        else:
            print(repr(self))


def _with(config: dict[str, Any] | None) -> dict[str, Any]:
    return {**(config or {}), **CHART_CONFIG}  # a copy: plotly takes entries out of what it is given
