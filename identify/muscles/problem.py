"""Several muscles at one joint as one function of all their parameters: the torques add up, but for their interplay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.effects.base import Form
from stimrig.identify.errors import BadRequest
from stimrig.identify.muscles.interplay import Interplay, JointForm, Other, find
from stimrig.identify.recruitment import Basis
from stimrig.identify.simulation.problem import Chosen, Problem

CHANGE = 1e-5
"""Of a level, for derivatives of the interplay."""


@dataclass(frozen=True)
class Acting:
    """An interplay in one form, and between which channels: indices, None for the joint."""

    interplay: Interplay
    form: str
    between: tuple[int, int] | None = None  # from which, to which

    @classmethod
    def of(cls, text: str, names: Sequence[str]) -> Acting:
        """The first one that a text means. Raises BadRequest: as `meant`."""
        return cls.meant(text, names)[0]

    @classmethod
    def meant(cls, text: str, names: Sequence[str]) -> list[Acting]:
        """Each form that "id", "id:form", "id:from>to" or "id:from>to:form" leaves open.

        Raises BadRequest: unknown, or no such channels.
        """
        identifier, *more = text.split(":")
        interplay = find(identifier)
        between = None
        if more and ">" in more[0]:
            ends = more.pop(0).split(">")
            if len(ends) != 2 or ends[0] == ends[1] or not set(ends) <= set(names):
                raise BadRequest(
                    f"{text!r}: no such channels", place="interplay", fix=f"Use two of {', '.join(names)}."
                )
            between = names.index(ends[0]), names.index(ends[1])
        if interplay.directed != (between is not None):
            fix = (
                f"Write '{identifier}:{names[0]}>{names[1]}', with the quotes."
                if interplay.directed
                else f"Write {identifier} alone."
            )
            raise BadRequest(
                f"{text!r} {'names no' if interplay.directed else 'names'} channels", place="interplay", fix=fix
            )
        forms = [interplay.form(more[0])] if more else interplay.forms
        return [cls(interplay, form.name, between) for form in forms]

    def key(self, names: Sequence[str]) -> str:
        """What it is called: "co_contraction", or "cross_talk:biceps>triceps"."""
        if self.between is None:
            return self.interplay.id
        return f"{self.interplay.id}:{names[self.between[0]]}>{names[self.between[1]]}"


def drive_form(acting: Acting, grids: Sequence[Grid], bases: Sequence[Basis]) -> Form:
    """The form of the stage "gain" by which one channel's pulses reach the other muscle."""
    assert acting.between is not None
    giving, taking = (grids[place] for place in acting.between)
    share = giving.pulse_width_us / max(bases[acting.between[0]].largest_us, 1e-9)
    ahead = (taking.offset_s - giving.offset_s) / giving.step_s
    if ahead >= 0.0:
        other = Other((share, np.r_[share[1:], 0.0]), ahead)
    else:
        other = Other((np.r_[0.0, share[:-1]], share), 1.0 + ahead)
    return acting.interplay.form(acting.form).make(other)


class JointProblem(Problem):
    """What `solve` needs of a problem, for several muscles.

    `theta` holds the parameters of each muscle's problem, in order, then those of forms that act on the joint. Each
    muscle's torque is counted from the zero of the first one; the others' baselines are held at 0 by their set-up.

    Parameters
    ----------
    parts : sequence of Problem
        One for each channel, with the interplay that acts on its drive among its effects.
    joint : sequence of (Interplay, JointForm)
        What acts on the torques.
    """

    def __init__(self, parts: Sequence[Problem], joint: Sequence[tuple[Interplay, JointForm]] = ()) -> None:
        # Nothing of one muscle's problem is made: each part has its own.
        self.parts, self.joint = tuple(parts), tuple(joint)
        self.setup = parts[0].setup
        first = np.cumsum([0, *(part.size for part in parts)]).tolist()
        self.places = [slice(a, b) for a, b in pairwise(first)]
        self.signs = np.array([part.setup.sign for part in parts])
        self.turned = self.signs * self.signs[0]
        self.scales_nm = np.array([part.setup.scale_nm for part in parts])
        self.chosen = [
            replace(one, first=one.first + place.start)
            for part, place in zip(parts, self.places, strict=True)
            for one in part.chosen
        ]
        own, at = [], first[-1]
        for interplay, form in joint:
            own.append(
                Chosen(interplay.id, Form(form.name, "joint", form.equation, form.parameters), form.parameters, at)
            )
            at += len(form.parameters)
        self.chosen += own
        self.own, self.size = own, at
        table = [p for one in own for p in one.parameters]
        self.log = np.r_[np.concatenate([part.log for part in parts]), np.zeros(len(table), bool)].astype(bool)
        self.lower = np.r_[np.concatenate([part.lower for part in parts]), [p.lower for p in table]]
        self.upper = np.r_[np.concatenate([part.upper for part in parts]), [p.upper for p in table]]
        self.cores = np.concatenate([place.start + part.cores for part, place in zip(parts, self.places, strict=True)])

    def fitted_on(self, rows: np.ndarray) -> JointProblem:
        """The same, of which only these intervals are fitted, bool, shape (K,)."""
        return JointProblem([part.fitted_on(rows) for part in self.parts], self.joint)

    def split(self, theta: np.ndarray) -> list[np.ndarray]:
        """The parameters of each muscle's problem."""
        return [theta[place] for place in self.places]

    def physical(self, theta: np.ndarray) -> np.ndarray:
        """Parameters in their units."""
        own = [part.physical(one) for part, one in zip(self.parts, self.split(theta), strict=True)]
        return np.r_[np.concatenate(own), theta[self.places[-1].stop :]]

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and precision matrix of the prior of `theta`."""
        mean, precision = np.zeros(self.size), np.zeros((self.size, self.size))
        for part, place in zip(self.parts, self.places, strict=True):
            mean[place], precision[place, place] = part.prior
        rest = slice(self.places[-1].stop, self.size)
        lower, upper = self.lower[rest], self.upper[rest]
        mean[rest] = 0.5 * (lower + upper)
        precision[rest, rest] = np.diag((3.0 / (upper - lower)) ** 2)
        return mean, precision

    def parameters(self, theta: np.ndarray) -> list[dict[str, float]]:
        """Of each form that acts on the joint, by name."""
        return [{p.name: float(theta[i]) for i, p in zip(one.places, one.parameters, strict=True)} for one in self.own]

    def run(
        self, theta: np.ndarray, *, derivatives: bool = False, skip: frozenset[str] = frozenset()
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Predicted interval means, N·m, shape (K,), in the first muscle's frame, and derivatives, shape (P, K)."""
        ran = [
            part.run(one, derivatives=derivatives, skip=skip)
            for part, one in zip(self.parts, self.split(theta), strict=True)
        ]
        levels = np.stack([self._level(place, theta, mean) for place, (mean, _) in enumerate(ran)])
        total = sum(turn * mean for turn, (mean, _) in zip(self.turned, ran, strict=True))
        values = self.parameters(theta)
        now = self._interplay(levels, values)
        total = total + now
        if not derivatives:
            return total, None
        jacobian = np.zeros((self.size, total.size))
        for place, (part, (_, slopes)) in enumerate(zip(self.parts, ran, strict=True)):
            assert slopes is not None
            own = jacobian[self.places[place]]
            own += self.turned[place] * slopes
            if self.joint:
                moved = levels.copy()
                moved[place] += CHANGE
                by = (self._interplay(moved, values) - now) / CHANGE
                shown = slopes.copy()
                shown[list(part.baselines)] = 0.0
                own += by / self.scales_nm[place] * shown
        for one in self.own:
            for place in one.places:
                step = CHANGE if theta[place] + CHANGE <= self.upper[place] else -CHANGE
                there = theta.copy()
                there[place] += step
                jacobian[place] = (self._interplay(levels, self.parameters(there)) - now) / step
        return total, jacobian

    def _level(self, place: int, theta: np.ndarray, torque_nm: np.ndarray, at_samples: bool = False) -> np.ndarray:
        """A muscle's torque without its baseline, as a share of its largest."""
        part = self.parts[place]
        baselines = theta[self.places[place]][list(part.baselines)]
        which = part.setup.part_of(at_samples)
        return (torque_nm - (baselines[0] if which is None else baselines[which])) / self.scales_nm[place]

    def _interplay(self, levels: np.ndarray, values: Sequence[Mapping[str, Any]]) -> np.ndarray:
        """What the forms on the joint change, N·m, in the frame of the first muscle."""
        change = np.zeros(levels.shape[1:])
        for (_, form), p in zip(self.joint, values, strict=True):
            own = form.apply(levels, self.signs, dict(p))
            change = change + np.einsum("c,c...->...", self.turned * self.scales_nm, own)
        return change

    def at_samples(self, theta: np.ndarray, skip: frozenset[str] = frozenset()) -> np.ndarray:
        """Torque at the record's samples, with its sign and zero, N·m."""
        return self.whole_and_parts(theta, skip)[0]

    def whole_and_parts(
        self, theta: np.ndarray, skip: frozenset[str] = frozenset()
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """The same, and the torque of each muscle with the record's sign, without zero and interplay on the joint."""
        levels = []
        for place, (part, one) in enumerate(zip(self.parts, self.split(theta), strict=True)):
            levels.append(self._level(place, theta, part.setup.to_muscle(part.at_samples(one, skip)), at_samples=True))
        stacked = np.stack(levels)
        own = stacked * self.scales_nm[:, None]
        which = self.setup.part_of(True)
        baselines = theta[self.places[0]][list(self.parts[0].baselines)]
        total = baselines[0] if which is None else baselines[which]
        total = total + self.turned @ own + self._interplay(stacked, self.parameters(theta))
        return self.setup.to_record(np.asarray(total)), [sign * one for sign, one in zip(self.signs, own, strict=True)]
