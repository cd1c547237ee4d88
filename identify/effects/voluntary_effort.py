"""Voluntary effort or spasm: torque that does not depend on the stimulation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene
from stimrig.identify.effects.kernels import bumps

MOST = 6
"""Largest number of bumps: more of them could imitate any error."""


_PARTS = (("centre", "s"), ("width", "s"), ("height", "nm"))


def _bumps(count: int) -> Callable[..., np.ndarray]:
    def apply(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
        centre, width, height = (
            np.concatenate([p[f"{part}_{i}_{unit}"] for i in range(count)], axis=1) for part, unit in _PARTS
        )
        return bumps(scene.time_s, centre, width, height, p["flatness"][:, 0])

    return apply


Match = tuple[float, float, int, float]
"""How well a shape matches a residual: score, its duration, s, the interval at which it begins or lies, its height."""


def _best(match: np.ndarray, power: np.ndarray, duration_s: float) -> Match:
    """The place at which a shape matches best, from its products with the residual and their expected power."""
    score = np.where(match > 0, match**2 / power, 0.0)
    at = int(np.argmax(score))
    return float(score[at]), duration_s, at, float(match[at] / power[at])


def _propose(count: int, sign: float) -> Callable[..., list[dict[str, float]]]:
    def propose(residual_nm: np.ndarray, scene: Scene, previous: dict[str, float]) -> list[dict[str, float]]:
        """The two bumps that match the residual best, among a few widths."""
        known = np.isfinite(residual_nm)
        value = sign * np.where(known, residual_nm, 0.0)
        found = []
        for width_s in (0.2, 0.5, 1.2):
            half = int(np.ceil(3 * width_s / scene.step_s))
            kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * scene.step_s / width_s) ** 2)
            match = np.convolve(value, kernel, "same")
            power = np.convolve(known.astype(float), kernel**2, "same") + 0.3 * np.sum(kernel**2)
            found.append(_best(match, power, width_s))
        i = count - 1
        return [
            {"flatness": 2.0}
            | dict(previous)
            | {f"centre_{i}_s": float(scene.time_s[at]), f"width_{i}_s": width_s, f"height_{i}_nm": sign * height}
            for score, width_s, at, height in sorted(found, reverse=True)[:2]
            if score > 0.0
        ]

    return propose


def _spasms(count: int) -> Callable[..., np.ndarray]:
    def apply(_: None, p: dict[str, Any], scene: Scene) -> np.ndarray:
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

    return apply


def _propose_spasm(count: int) -> Callable[..., list[dict[str, float]]]:
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
        i = count - 1
        burst = {f"centre_{i}_s": float(scene.time_s[at]), f"decay_{i}_s": decay_s, f"height_{i}_nm": height}
        return [{"rise_s": 0.07} | dict(previous) | burst]

    return propose


def _spasm_parameters(count: int) -> tuple[Parameter, ...]:
    listed = [Parameter("rise_s", "s", 0.02, 0.14, 0.07, (0.07,), "log", about="time constant of the rise")]
    for i in range(count):
        listed += [
            Parameter(f"centre_{i}_s", "s", 0.0, 1.0, 0.0, (0.5,), relative="span", about="start"),
            Parameter(f"decay_{i}_s", "s", 0.15, 3.0, 0.6, (0.6,), "log", about="time constant of the decay"),
            Parameter(f"height_{i}_nm", "N·m", 0.0, 0.9, 0.0, (0.1,), relative="torque", about="peak torque"),
        ]
    return tuple(listed)


def _in_fitted_rows(count: int) -> Callable[[dict[str, float], Scene], bool]:
    def accept(p: dict[str, float], scene: Scene) -> bool:
        """Accept bumps in fitted rows only. In other rows a bump could only repair errors in the rows beside them."""
        if scene.fitted is None:
            return True
        at = np.array([p[f"centre_{i}_s"] for i in range(count)])
        place = np.clip(np.searchsorted(scene.time_s, at), 0, scene.time_s.size - 1)
        return bool(np.all(scene.fitted[place]))

    return accept


def _parameters(count: int, sign: float) -> tuple[Parameter, ...]:
    low, high = (0.0, 0.9) if sign > 0 else (-0.9, 0.0)
    listed = [Parameter("flatness", "1", 1.6, 6.0, 2.0, (2.0,), "log", about="2: Gaussian; larger: flatter")]
    for i in range(count):
        listed += [
            Parameter(f"centre_{i}_s", "s", 0.0, 1.0, 0.0, (0.5,), relative="span", about="middle"),
            Parameter(f"width_{i}_s", "s", 0.14, 3.0, 0.5, (0.5,), "log", about="half-width"),
            Parameter(f"height_{i}_nm", "N·m", low, high, 0.0, (0.1 * sign,), relative="torque", about="peak torque"),
        ]
    return tuple(listed)


EFFECT = Effect(
    id="voluntary_effort",
    name="Voluntary effort or spasm",
    forms=tuple(
        Form(
            f"{name}_{count}",
            "additive",
            f"y + Σ height·exp(-|t - centre|^flatness/(2 width^flatness)), {count} bumps, {words}",
            _parameters(count, sign),
            _bumps(count),
            batched=True,
            propose=_propose(count, sign),
            accept=_in_fitted_rows(count),
            grows=count > 1,
        )
        for name, words, sign in (("bumps", "in the direction of pull", 1.0), ("resisting", "against it", -1.0))
        for count in range(1, MOST + 1)
    )
    + tuple(
        Form(
            f"spasms_{count}",
            "additive",
            f"y + Σ height·(exp(-t/decay) - exp(-t/rise)), t since its start, {count} bursts",
            _spasm_parameters(count),
            _spasms(count),
            batched=True,
            propose=_propose_spasm(count),
            accept=_in_fitted_rows(count),
            grows=count > 1,
        )
        for count in range(1, MOST + 1)
    ),
    signature="Single bumps of torque, also at rest, at times that do not depend on the stimulation.",
    resembles=("threshold_drift", "recruitment_hysteresis", "catch_like", "baseline_drift"),
    separated_by="A test without stimulation; EMG; the instruction to relax.",
    plain="The participant helped, resisted, or had a spasm. No model of the muscle can predict this. Repeat the test "
    "with the instruction to relax, or leave these parts out.",
    source="Additive torque that does not depend on the stimulation",
    predictable=False,
    prior=-5.0,
)
