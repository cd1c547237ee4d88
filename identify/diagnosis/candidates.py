"""Every effect of the library tried on a model: its most likely form, and the evidence for it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from stimrig.identify.diagnosis.side_by_side import side_by_side
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene
from stimrig.identify.estimation.effect_fit import Candidate, effect_names, try_effect
from stimrig.identify.estimation.joint import Fitted
from stimrig.identify.simulation.problem import Problem
from stimrig.identify.simulation.setup import Setup

WORKERS = min(2, os.cpu_count() or 1)
"""Processes that try effects in parallel."""
FORMS = 3
"""Forms of an effect that are tried beside another effect."""

Progress = Callable[[float, str], None]
_Tried = tuple[str, Fitted, float, dict[str, float]]
"""Form, fit without its problem (it holds functions, which cannot be sent between processes), gain, gains by form."""


def silent(_share: float, _text: str) -> None:
    """A `Progress` that tells nobody."""


def applicable(effect: Effect, setup: Setup, present: Iterable[str]) -> bool:
    """Whether an effect can be tried: the record has its columns, no earlier step looks for it, and it is not
    present."""
    record = setup.grid.record
    if effect.raw or effect.id in present:
        return False
    return all(getattr(record, need) is not None for need in effect.needs)


def likeliest_forms(effect: Effect, before: Candidate | None) -> list[Form]:
    """Forms to try beside another effect: those that were best alone; all forms of a chain."""
    if before is None or effect.band or any(form.grows for form in effect.forms):
        return list(effect.forms)
    ranked = sorted(before.forms, key=lambda name: -before.forms[name])
    return [effect.form(name) for name in ranked[:FORMS]]


def scan(
    base: Fitted,
    effects: Iterable[Effect],
    progress: Progress | None = None,
    share: tuple[float, float] = (0.0, 1.0),
    before: list[Candidate] | None = None,
) -> list[Candidate]:
    """Add each applicable effect to a model; best first. `before` holds the candidates of an earlier round."""
    present = set(effect_names(base))
    listed = [effect for effect in effects if applicable(effect, base.problem.setup, present)]
    # Slow ones first, so that all processes end at about the same time.
    listed.sort(key=lambda effect: -len(effect.forms))
    earlier = {candidate.effect.id: candidate for candidate in before or []}

    def tried(number: int) -> _Tried | None:
        effect = listed[number]
        found = try_effect(effect, base, likeliest_forms(effect, earlier.get(effect.id)))
        return found and (found.form.name, replace(found.fitted, problem=None), found.gain, found.forms)

    found: list[Candidate] = []
    for done, (number, result) in enumerate(side_by_side(tried, len(listed), WORKERS), start=1):
        effect = listed[number]
        if progress is not None:
            progress(share[0] + (share[1] - share[0]) * done / len(listed), f"tried {effect.name.lower()}")
        if result is not None:
            form = effect.form(result[0])
            added = [] if effect.band else [(effect.id, form)]
            problem = Problem(base.problem.setup, [*base.effects, *added])
            found.append(Candidate(effect, form, replace(result[1], problem=problem), *result[2:]))
    return sorted(found, key=lambda candidate: (-candidate.gain, candidate.effect.id))


KNOTS = 36


def _free_gain(drive: np.ndarray, p: dict[str, Any], scene: Scene) -> np.ndarray:
    place = np.clip(scene.time_s / max(scene.span_s, 1e-9), 0.0, 1.0) * (KNOTS - 1)
    first = np.minimum(place.astype(np.int64), KNOTS - 2)
    part = place - first
    values = np.concatenate([p[f"log_gain_{i}"] for i in range(KNOTS)], axis=1)
    return drive * np.exp(values[:, first] * (1.0 - part) + values[:, first + 1] * part)


FREE_GAIN = Effect(
    id="free_gain",
    name="Gain that varies without a law",
    forms=(
        Form(
            "free",
            "gain",
            "w = g(t) f(u), log g linear between knots",
            tuple(
                Parameter(f"log_gain_{i}", "1", -0.45, 0.45, 0.0, (0.0,), about="log gain at a knot")
                for i in range(KNOTS)
            ),
            _free_gain,
            batched=True,
        ),
    ),
    signature="",
    resembles=(),
    separated_by="",
    plain="",
)
