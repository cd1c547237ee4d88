"""A plan, with what is kept beside it of a test that stops itself, or of a guided test of a joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rig.messages import TestPlan


@dataclass(frozen=True)
class Planned:
    """A plan, and what else is known of it before it is played.

    Parameters
    ----------
    how, reach : dict or None
        Of an adaptive test: what it shall reach, and what it probably will.
    joint : dict or None
        Of a guided test of a joint: doses, target, longest time.
    """

    plan: TestPlan
    how: dict[str, Any] | None = None
    reach: dict[str, Any] | None = None
    joint: dict[str, Any] | None = None

    def kept(self) -> dict[str, Any]:
        """What is kept beside the plan; nothing of a test of another kind."""
        if self.joint is not None:
            return {"joint": self.joint}
        if self.how is None or self.plan.adaptive is None:
            return {}
        return {"target": self.how["target"], "reach": self.reach, "bounds": self.plan.adaptive.model_dump()}
