"""What muscles at one joint do to each other; one file each, found by looking into this folder.

A file holds `INTERPLAY`: an id, words, and its forms. A form acts at one of two places:

- "drive": one channel's pulses add to what the other muscle's pulses recruit. `form(other)` makes a `Form` of the stage
  "gain" for the other muscle's problem, from what the channel's pulses were (`Other`).
- "joint": the muscles' torques together make the joint's. `apply(levels, signs, p)` takes each muscle's torque as a
  share of its largest and returns by how much of its largest each is changed.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from stimrig.identify.effects.base import Form, Parameter
from stimrig.identify.errors import BadRequest


@dataclass(frozen=True)
class Other:
    """The pulses of another channel, as they fall into the intervals of a muscle's own pulses."""

    shares: tuple[np.ndarray, np.ndarray]  # shape (K,); widths over the largest, of the earlier and the later pulse
    later: float  # share of an interval in which the later one is in force

    def mean(self, level: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Mean over each interval of something that follows from the width."""
        earlier, later = (level(one) for one in self.shares)
        return (1.0 - self.later) * earlier + self.later * later


@dataclass(frozen=True)
class JointForm:
    """One form of an interplay that acts on the torques."""

    name: str
    equation: str
    parameters: tuple[Parameter, ...]
    apply: Callable[[np.ndarray, np.ndarray, dict[str, Any]], np.ndarray]
    """`apply(levels, signs, p)`: levels of shape (C, ..., K), signs of shape (C,), parameters that broadcast with one
    level; returns the torque's change in units of each muscle's largest, shape (C, ..., K). 0 at the neutral values."""


@dataclass(frozen=True)
class Interplay:
    """One way in which muscles at one joint affect each other."""

    id: str
    name: str
    directed: bool  # from one channel to another; else it is of the joint
    forms: tuple[Any, ...]  # of `Callable[[Other], Form]` with a `name`, or `JointForm`
    signature: str  # what it looks like in the residual of a model without it
    resembles: tuple[str, ...]
    separated_by: str  # the test that separates them
    plain: str  # a paragraph for clinicians
    source: str = ""

    def form(self, name: str) -> Any:
        """A form by its name. Raises BadRequest: there is none."""
        for one in self.forms:
            if one.name == name:
                return one
        known = ", ".join(one.name for one in self.forms)
        raise BadRequest(f"{self.id} has no form {name!r}", place="interplay", fix=f"It has: {known}.")


@dataclass(frozen=True)
class DriveForm:
    """One form of an interplay that acts on what is recruited: `make(other)` is a form of the stage "gain"."""

    name: str
    equation: str
    make: Callable[[Other], Form]


@cache
def registry() -> dict[str, Interplay]:
    """All kinds of interplay by id."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    found = (importlib.import_module(f"{__name__}.{name}").INTERPLAY for name in names)
    return {one.id: one for one in found}


def find(interplay: str) -> Interplay:
    """By its id. Raises BadRequest: there is none."""
    if interplay not in registry():
        fix = f"Use one of: {', '.join(registry())}."
        raise BadRequest(f"unknown interplay {interplay!r}", place="interplay", fix=fix)
    return registry()[interplay]
