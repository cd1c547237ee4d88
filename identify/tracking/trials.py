"""Several trials followed one after the other, as a program has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stimrig.identify.errors import BadRequest
from stimrig.identify.json_text import json_value
from stimrig.identify.model import Model
from stimrig.identify.records.record import Record
from stimrig.identify.results import Result
from stimrig.identify.summary import Sheet, quantity
from stimrig.identify.tracking.follow import Step, follow, model_for_next


@dataclass(frozen=True, repr=False, eq=False)
class Tracked(Result):
    """A model followed over trials: gain, threshold and time scale after each."""

    approved: Model  # the model that was followed; it stays as it is
    steps: tuple[Step, ...]  # one for each trial

    @property
    def model(self) -> Model:
        """The model as it is expected to be in the next trial."""
        return model_for_next(self.approved, self.steps[-1])

    def to_dict(self) -> dict[str, Any]:
        """For each trial its outcome, and the levels `now` and `coming` with their bands (95 %)."""
        return {"model_id": self.approved.model_id, "trials": [json_value(step.to_dict()) for step in self.steps]}

    def _sheet(self) -> Sheet:
        rows = [(f"trial {number}", _levels(step)) for number, step in enumerate(self.steps, 1)]
        hidden = [("", f"and {len(rows) - 9} trials before")] if len(rows) > 9 else []
        return Sheet(f"Model {self.approved.model_id[:8]} over {len(rows)} trials", (*hidden, *rows[-9:]))


def _levels(step: Step) -> str:
    now = step.after.values
    moved = f"gain {quantity(now.gain, '')}, threshold {now.threshold_shift_us:+.3g} µs"
    return f"{step.outcome}: {moved}, time scale {quantity(now.time_scale, '')}, error {step.fit.error_nm:.3g} N·m"


def track(model: Model, trials: Sequence[Record]) -> Tracked:
    """Follow a model over trials, in their order: how the muscle's gain, threshold and time scale have moved.

    Parameters
    ----------
    model : Model
        With second-order dynamics.
    trials : sequence of Record
        At least one, each with its rest before and after.

    Raises
    ------
    BadModel, BadRecord
        As `stimrig.identify.tracking.follow`.
    BadRequest
        No trial is given.
    """
    steps: list[Step] = []
    for trial in trials:
        steps.append(follow(model, steps[-1].coming if steps else None, trial))
    if not steps:
        raise BadRequest("no trial", place="trials", fix="Give at least one record.")
    return Tracked(model, tuple(steps))
