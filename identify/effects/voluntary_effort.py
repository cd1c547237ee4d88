"""Voluntary effort or spasm: torque that does not depend on the stimulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Values

MOST = 6
"""Largest number of bumps: more of them could imitate any error."""
Match = tuple[float, float, int, float]
"""How well a shape matches a residual: score, its duration, s, the interval at which it begins or lies, its height."""
Propose = Callable[[np.ndarray, Scene, dict[str, float]], list[dict[str, float]]]


def _forms(
    name: str,
    equation: Callable[[int], str],
    parts: Callable[[int], tuple[Parameter, ...]],
    shared: Parameter,
    apply: Callable[[Values, Scene, int], np.ndarray],
    propose: Callable[[int], Propose],
) -> list[Form]:
    """A chain of forms: one bump, two bumps, …, each of which has parameters of its own beside a shared one."""
    return [
        Form(
            f"{name}_{count}",
            "additive",
            equation(count),
            (shared, *(p for i in range(count) for p in parts(i))),
            lambda _, p, scene, count=count: apply(p, scene, count),
            batched=True,
            propose=propose(count - 1),
            accept=_in_fitted_rows(count),
            grows=count > 1,
        )
        for count in range(1, MOST + 1)
    ]


def _in_fitted_rows(count: int) -> Callable[[dict[str, float], Scene], bool]:
    def accept(p: dict[str, float], scene: Scene) -> bool:
        """Accept bumps in fitted rows only. In other rows a bump could only repair errors in the rows beside them."""
        if scene.fitted is None:
            return True
        at = np.array([p[f"centre_{i}_s"] for i in range(count)])
        place = np.clip(np.searchsorted(scene.time_s, at), 0, scene.time_s.size - 1)
        return bool(np.all(scene.fitted[place]))

    return accept


def _best(match: np.ndarray, power: np.ndarray, duration_s: float) -> Match:
    """The place at which a shape matches best, from its products with the residual and their expected power."""
    score = np.where(match > 0, match**2 / power, 0.0)
    at = int(np.argmax(score))
    return float(score[at]), duration_s, at, float(match[at] / power[at])


# ---- bumps ----


@njit(cache=True, nogil=True)
def _sum_of_bumps(
    time_s: np.ndarray, centre: np.ndarray, width: np.ndarray, height: np.ndarray, flatness: np.ndarray
) -> np.ndarray:  # pragma: no cover
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


def _bump_forms(name: str, words: str, sign: float) -> list[Form]:
    low, high = (0.0, 0.9) if sign > 0 else (-0.9, 0.0)

    def parts(i: int) -> tuple[Parameter, ...]:
        return (
            Parameter(f"centre_{i}_s", "s", 0.0, 1.0, 0.0, (0.5,), relative="span", about="middle"),
            Parameter(f"width_{i}_s", "s", 0.14, 3.0, 0.5, (0.5,), "log", about="half-width"),
            Parameter(f"height_{i}_nm", "N·m", low, high, 0.0, (0.1 * sign,), relative="torque", about="peak torque"),
        )

    def propose(i: int) -> Propose:
        def proposed(residual_nm: np.ndarray, scene: Scene, previous: dict[str, float]) -> list[dict[str, float]]:
            """The two bumps that match the residual best, among a few widths."""
            known = np.isfinite(residual_nm)
            value = sign * np.where(known, residual_nm, 0.0)
            found = []
            for width_s in (0.2, 0.5, 1.2):
                half = int(np.ceil(3 * width_s / scene.step_s))
                kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * scene.step_s / width_s) ** 2)
                own = slice(half, half + known.size)  # not "same": of a record shorter than the kernel it is longer
                match = np.convolve(value, kernel)[own]
                power = np.convolve(known.astype(float), kernel**2)[own] + 0.3 * np.sum(kernel**2)
                found.append(_best(match, power, width_s))
            return [
                {"flatness": 2.0}
                | dict(previous)
                | {f"centre_{i}_s": float(scene.time_s[at]), f"width_{i}_s": width_s, f"height_{i}_nm": sign * height}
                for score, width_s, at, height in sorted(found, reverse=True)[:2]
                if score > 0.0
            ]

        return proposed

    def equation(count: int) -> str:
        return f"y + Σ height·exp(-|t - centre|^flatness/(2 width^flatness)), {count} bumps, {words}"

    flatness = Parameter("flatness", "1", 1.6, 6.0, 2.0, (2.0,), "log", about="2: Gaussian; larger: flatter")
    return _forms(name, equation, parts, flatness, _bumps, propose)


# ---- spasms ----


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


def _spasm_parts(i: int) -> tuple[Parameter, ...]:
    return (
        Parameter(f"centre_{i}_s", "s", 0.0, 1.0, 0.0, (0.5,), relative="span", about="start"),
        Parameter(f"decay_{i}_s", "s", 0.15, 3.0, 0.6, (0.6,), "log", about="time constant of the decay"),
        Parameter(f"height_{i}_nm", "N·m", 0.0, 0.9, 0.0, (0.1,), relative="torque", about="peak torque"),
    )


def _propose_spasm(i: int) -> Propose:
    def propose(residual_nm: np.ndarray, scene: Scene, previous: dict[str, float]) -> list[dict[str, float]]:
        """The burst that matches the residual best, among a few decay times."""
        known = np.isfinite(residual_nm)
        value = np.where(known, residual_nm, 0.0)
        found = []
        for decay_s in (0.3, 0.8, 1.8):
            age = np.arange(int(np.ceil(4 * decay_s / scene.step_s))) * scene.step_s
            kernel = np.exp(-age / decay_s) - np.exp(-age / (0.1 * decay_s))
            kernel /= kernel.max()
            match = np.convolve(value, kernel[::-1])[kernel.size - 1 :]
            power = np.convolve(known.astype(float), (kernel**2)[::-1])[kernel.size - 1 :] + 0.3 * np.sum(kernel**2)
            found.append(_best(match, power, decay_s))
        score, decay_s, at, height = max(found)
        if score <= 0.0:
            return []
        burst = {f"centre_{i}_s": float(scene.time_s[at]), f"decay_{i}_s": decay_s, f"height_{i}_nm": height}
        return [{"rise_s": 0.07} | dict(previous) | burst]

    return propose


EFFECT = Effect(
    id="voluntary_effort",
    name="Voluntary effort or spasm",
    forms=(
        *_bump_forms("bumps", "in the direction of pull", 1.0),
        *_bump_forms("resisting", "against it", -1.0),
        *_forms(
            "spasms",
            lambda count: f"y + Σ height·(exp(-t/decay) - exp(-t/rise)), t since its start, {count} bursts",
            _spasm_parts,
            Parameter("rise_s", "s", 0.02, 0.14, 0.07, (0.07,), "log", about="time constant of the rise"),
            _spasms,
            _propose_spasm,
        ),
    ),
    signature="Single bumps of torque, also at rest, at times that do not depend on the stimulation.",
    resembles=("threshold_drift", "recruitment_hysteresis", "catch_like", "baseline_drift"),
    separated_by="A test without stimulation; EMG; the instruction to relax.",
    plain="The participant helped, resisted, or had a spasm. No model of the muscle can predict this. Repeat the test "
    "with the instruction to relax, or leave these parts out.",
    source="Additive torque that does not depend on the stimulation",
    predictable=False,
    sporadic=True,
    prior=-5.0,
    muscle=False,
    main={"height_0_nm": "peak torque"},
)
