"""What can be asked of a model: one muscle's can do all, one of several muscles at a joint lacks some, and says so.

Workers take both with the same verbs. What one kind cannot do stands here, as the sentence that is told instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from stimrig.api.errors import ApiError
from stimrig.api.models.stored_model import JOINT


@dataclass(frozen=True)
class Family:
    """A kind of models. `lacks`: what cannot be asked of it, and the sentence that says so."""

    lacks: Mapping[str, str] = field(default_factory=dict)

    def can(self, what: str) -> bool:
        """Whether it can be asked for this."""
        return what not in self.lacks

    def require(self, what: str) -> None:
        """Raise ApiError (409) where it cannot be asked for this."""
        if not self.can(what):
            title = "Not of a model of several muscles"
            raise ApiError(409, "several-muscles", title, self.lacks[what])


ONE_MUSCLE = Family()
SEVERAL_MUSCLES = Family({
    "tracking": "A model of several muscles does not follow them from trial to trial: all stays as approved.",
    "widths": "Pulse widths for a torque are found with the model of one muscle: with several, many would do.",
    "prediction": "A torque is foretold from the pulse widths of one muscle; this model has several.",
    "trend": "Models of several muscles are not in it: it follows one muscle from session to session.",
    "compared": "Models are laid side by side where each is of one muscle; this one is of several.",
    "story": "The story is told of models of one muscle; the versions of this one are on its page.",
    "joined": "A recording of several muscles is not joined to another one.",
    "carried": "The structure of a model of several muscles is not carried over to another session.",
})  # fmt: skip


def family_of(row: Any) -> Family:
    """The kind of a version, by its row."""
    return SEVERAL_MUSCLES if row.method == JOINT else ONE_MUSCLE
