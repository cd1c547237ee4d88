"""Voluntary effort or spasm: torque that does not depend on the stimulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values

MAX_BUMPS = 6
"""Largest number of bumps: more of them could imitate any error."""
Shape = Callable[[float, float], tuple[np.ndarray, int]]
"""A shape of a duration, s, at steps, s: what is sought in a residual; and the place in it that its `centre` is."""


class _Bursts(Form):
    """A form of bursts in fitted rows: in other rows they could only repair errors in the rows beside them."""

    def accepts(self, parameters: dict[str, float], scene: Scene) -> bool:
        if scene.fitted is None:
            return True
        at = [value for name, value in parameters.items() if name.startswith("centre_")]
        place = np.clip(np.searchsorted(scene.time_s, at), 0, scene.time_s.size - 1)
        return bool(np.all(scene.fitted[place]))


def _forms(
    name: str,
    equation: str,
    apply: Callable[[Values, Scene, int], np.ndarray],
    shape: Shape,
    durations_s: tuple[float, ...],
    shared: Parameter,
    sign: float = 1.0,
) -> list[Form]:
    """A chain of forms: one burst, two bursts, …, each with a centre, duration and height beside a shared parameter."""
    kind = "width" if shared is _FLATNESS else "decay"
    low, high = sorted((0.0, 0.9 * sign))

    def burst(i: int) -> tuple[Parameter, ...]:
        return (
            Parameter(f"centre_{i}_s", "s", 0.0, 1.0, 0.0, (0.5,), relative="span", about=_CENTRE[kind]),
            replace(_DURATION[kind], name=f"{kind}_{i}_s"),
            Parameter(f"height_{i}_nm", "N·m", low, high, 0.0, (0.1 * sign,), relative="torque", about="peak torque"),
        )

    def form(count: int) -> Form:
        def propose(residual_nm: np.ndarray, scene: Scene, previous: dict[str, float]) -> list[dict[str, float]]:
            """The shapes that match the residual best: of bumps two."""
            found = _matches(residual_nm, sign, {s: shape(s, scene.step_s) for s in durations_s})
            names = [p.name for p in burst(count - 1)]
            return [
                {shared.name: shared.start[0]}
                | previous
                | dict(zip(names, (float(scene.time_s[at]), duration_s, sign * height_nm), strict=True))
                for _, duration_s, at, height_nm in found[: 2 if kind == "width" else 1]
            ]

        return _Bursts(
            f"{name}_{count}",
            "additive",
            equation.format(count=count),
            (shared, *(p for i in range(count) for p in burst(i))),
            lambda _, p, scene: apply(p, scene, count),
            batched=True,
            propose=propose,
            grows=count > 1,
        )

    return [form(count) for count in range(1, MAX_BUMPS + 1)]


def _matches(
    residual_nm: np.ndarray, sign: float, shapes: dict[float, tuple[np.ndarray, int]]
) -> list[tuple[float, float, int, float]]:
    """Score, duration, s, interval and height, N·m, of shapes where each matches a residual best; the best first."""
    known = np.isfinite(residual_nm)
    value = sign * np.where(known, residual_nm, 0.0)
    matches = []
    for duration_s, (kernel, place) in shapes.items():
        after = kernel.size - 1 - place
        aligned = slice(after, after + known.size)  # not "same": of a record shorter than the kernel it is longer
        match = np.convolve(value, kernel[::-1])[aligned]
        power = np.convolve(known.astype(float), (kernel**2)[::-1])[aligned] + 0.3 * np.sum(kernel**2)
        score = np.where(match > 0, match**2 / power, 0.0)
        at = int(np.argmax(score))
        matches.append((float(score[at]), duration_s, at, float(match[at] / power[at])))
    return [candidate for candidate in sorted(matches, reverse=True) if candidate[0] > 0.0]


_CENTRE = {"width": "middle", "decay": "start"}
_DURATION = {
    "width": Parameter("", "s", 0.14, 3.0, 0.5, (0.5,), "log", about="half-width"),
    "decay": Parameter("", "s", 0.15, 3.0, 0.6, (0.6,), "log", about="time constant of the decay"),
}


# ---- bumps ----

_BUMP = "y + Σ height·exp(-|t - centre|^flatness/(2 width^flatness)), {count} bumps, "
_FLATNESS = Parameter("flatness", "1", 1.6, 6.0, 2.0, (2.0,), "log", about="2: Gaussian; larger: flatter")


@njit(cache=True, nogil=True)
def _sum_of_bumps(time_s, centre, width, height, flatness):  # pragma: no cover
    """Sum of bumps. Shapes (K,), (M, n) for each of three, flatness (M,); to (M, K). Negligible tails are skipped."""
    rows, count = centre.shape
    out = np.zeros((rows, time_s.size))
    for m in range(rows):
        reach = 80.0 ** (1.0 / flatness[m])
        for i in range(count):
            for k in range(time_s.size):
                away = abs((time_s[k] - centre[m, i]) / width[m, i])
                if away < reach:
                    out[m, k] += height[m, i] * np.exp(-0.5 * (away + 1e-12) ** flatness[m])
    return out


def _bumps(p: Values, scene: Scene, count: int) -> np.ndarray:
    centre, width, height = (
        np.concatenate([p[f"{part}_{i}_{unit}"] for i in range(count)], axis=1)
        for part, unit in (("centre", "s"), ("width", "s"), ("height", "nm"))
    )
    return _sum_of_bumps(scene.time_s, centre, width, height, p["flatness"][:, 0])


def _bump_shape(width_s: float, step_s: float) -> tuple[np.ndarray, int]:
    half = int(np.ceil(3 * width_s / step_s))
    return np.exp(-0.5 * (np.arange(-half, half + 1) * step_s / width_s) ** 2), half


# ---- spasms ----

_SPASM = "y + Σ height·(exp(-t/decay) - exp(-t/rise)), t since its start, {count} bursts"
_RISE = Parameter("rise_s", "s", 0.02, 0.14, 0.07, (0.07,), "log", about="time constant of the rise")


def _spasms(p: Values, scene: Scene, count: int) -> np.ndarray:
    total = np.zeros((p["rise_s"].shape[0], scene.time_s.size))
    rise = p["rise_s"]
    for i in range(count):
        age = np.clip(scene.time_s - p[f"centre_{i}_s"], 0.0, 1e3)
        decay = p[f"decay_{i}_s"]
        both = decay * rise / np.maximum(decay - rise, 1e-3)
        peak_s = both * np.log(np.maximum(decay / rise, 1.001))
        peak = np.exp(-peak_s / decay) - np.exp(-peak_s / rise)
        total += p[f"height_{i}_nm"] * (np.exp(-age / decay) - np.exp(-age / rise)) / np.maximum(peak, 1e-6)
    return total


def _spasm_shape(decay_s: float, step_s: float) -> tuple[np.ndarray, int]:
    age = np.arange(int(np.ceil(4 * decay_s / step_s))) * step_s
    shape = np.exp(-age / decay_s) - np.exp(-age / (0.1 * decay_s))
    return shape / shape.max(), 0


EFFECT = Effect(
    id="voluntary_effort",
    name="Voluntary effort or spasm",
    forms=(
        *_forms("bumps", _BUMP + "in the direction of pull", _bumps, _bump_shape, (0.2, 0.5, 1.2), _FLATNESS),
        *_forms("resisting", _BUMP + "against it", _bumps, _bump_shape, (0.2, 0.5, 1.2), _FLATNESS, -1.0),
        *_forms("spasms", _SPASM, _spasms, _spasm_shape, (0.3, 0.8, 1.8), _RISE),
    ),
    signature="Single bumps of torque, also at rest, at times that do not depend on the stimulation.",
    resembles=("threshold_drift", "recruitment_hysteresis", "catch_like", "baseline_drift"),
    separated_by="A test without stimulation; EMG; the instruction to relax.",
    plain="The participant helped, resisted, or had a spasm. No model can predict when this comes. Once it is in the "
    "model, it no longer distorts what is said of the muscle; predictions of another test leave it out.",
    source="Additive torque that does not depend on the stimulation",
    predictable=False,
    sporadic=True,
    prior=-5.0,
    muscle=False,
    main={"height_0_nm": "peak torque"},
)
