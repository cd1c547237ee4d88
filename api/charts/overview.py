"""The first chart of a model's page: torque measured and predicted, and what is left, low enough for the first screen.

It takes its lines from the large chart of the same page, so that they are sent once.
"""

from __future__ import annotations

from typing import Any

from stimrig.api.charts.model_charts import TOOLBAR_PX, axis
from stimrig.api.language import _

HEIGHT_PX = 260
LARGE = "comparison"
"""The figure with all lines."""


def overview(large: dict[str, Any]) -> dict[str, Any]:
    """Torque and residual of the large chart; `lines_of` names the figure whose lines are drawn.

    The pulse width is said under the pointer, and not drawn: `only_said`.
    """
    layout = large["layout"]
    shapes = layout["shapes"]
    labels = [{**label, "yanchor": "middle", "y": 0.36, "font": {**label["font"], "size": 11}}
              for label in layout["annotations"]]  # fmt: skip
    return {
        "lines_of": LARGE,
        "only_said": "y3",
        "layout": {
            **{name: value for name, value in layout.items() if name not in ("yaxis", "yaxis2")},
            "height": HEIGHT_PX,
            "shapes": shapes,
            "annotations": labels,
            "legend": {**layout["legend"], "y": 1.01, "font": {"size": 11}},
            "margin": {"l": 52, "r": TOOLBAR_PX, "t": 6, "b": 34},
            "xaxis": {**layout["xaxis"], "anchor": "y2"},
            "yaxis": axis(_("Torque (N·m)"), domain=[0.43, 1.0], nticks=5),
            "yaxis2": axis(_("Residual (N·m)"), domain=[0.0, 0.29], nticks=4),
            "yaxis3": {"visible": False, "domain": [0.0, 0.29], "overlaying": "y2"},
        },
    }
