"""The linear block G(q): second order in physical terms, or the general (l, n, d) of equations (1) to (3); and NARX."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stimrig.identify.dynamics.second_order import Core, boundary_states, read_means, recursion, transition

if TYPE_CHECKING:
    from stimrig.identify.dynamics.grid import Grid


TIME_CONSTANT_BOUNDS_S = (0.003, 4.0)
DAMPING_BOUNDS = (0.15, 8.0)
"""Bounds of the search; at the largest damping the second lag is too short to be seen."""


@dataclass(frozen=True)
class SecondOrder:
    """T² y'' + 2 ζ T y' + y = w(t - delay): unit gain at DC (section V of the paper)."""

    time_constant_s: float  # T, s (Tω in the paper)
    damping: float  # ζ, 1 is critical
    delay_s: float = 0.0  # delay after the pulses, s

    @property
    def core(self) -> Core:
        """T, s, and ζ."""
        return self.time_constant_s, self.damping

    def bounded(self, delay_bounds_s: tuple[float, float]) -> SecondOrder:
        """Within the bounds of a search."""
        bounds = zip(astuple(self), (TIME_CONSTANT_BOUNDS_S, DAMPING_BOUNDS, delay_bounds_s), strict=True)
        return SecondOrder(*(float(np.clip(value, *within)) for value, within in bounds))

    @property
    def memory_s(self) -> float:
        """Time after which the response to an impulse has fallen to about 1/1000, s."""
        slowest = self.damping - np.sqrt(max(self.damping**2 - 1.0, 0.0))
        return self.delay_s + 7.0 * self.time_constant_s / max(slowest, 1e-3)

    def on_grid(self, grid: Grid, drive_nm: np.ndarray) -> np.ndarray:
        """Interval means of the response from rest to a drive given on even slots, shape (K,) or (K, M), N·m."""
        drive = grid.interval_means(np.atleast_2d(drive_nm.T), axis=1)
        weights = grid.mean_weights(self.delay_s, grid.curve(self.core))
        rows = np.arange(len(drive))
        states = boundary_states(self.core, grid.step_s, drive)
        mean = read_means(*states, *weights, rows, np.empty(drive.shape), rows)
        return mean[0] if drive_nm.ndim == 1 else mean.T

    def discrete(self, sample_rate_hz: float) -> tuple[np.ndarray, np.ndarray, int]:
        """(b, a, d) of equations (1) to (3) at a sampling rate, exact for an input held between samples.

        A delay that is not a whole number of samples gives b a third coefficient.
        """
        step = 1.0 / sample_rate_hz
        # A small negative delay would need a future input: d is at least 0.
        whole = max(int(np.floor(self.delay_s / step + 1e-9)), -1)
        rest = max(self.delay_s - whole * step, 0.0)
        phi, gamma = transition(self.time_constant_s, self.damping, step)
        # The input changes `rest` after the sample: first the old value acts, then the new one for step - rest.
        newer = transition(self.time_constant_s, self.damping, step - rest)[1]
        older = gamma - newer
        a = np.array([1.0, -np.trace(phi), np.linalg.det(phi)])
        turn = phi - np.trace(phi) * np.eye(2)
        b = np.array([newer[0], (turn @ newer)[0] + older[0], (turn @ older)[0]])
        return (b[:2] if rest < 1e-9 * step else b) * (a.sum() / b.sum()), a, whole + 1

    def step_response(self, time_s: np.ndarray) -> np.ndarray:
        """Response to a unit step at zero, shape of `time_s`."""
        t = np.asarray(time_s, float)
        return step_responses(np.array([astuple(self)]), t.ravel())[0].reshape(t.shape)

    def to_dict(self) -> dict:
        return {"kind": "second-order"} | asdict(self)


def step_responses(dynamics: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Responses to a unit step of many (T, ζ, delay), shape (S, len(time_s))."""
    t = np.maximum(time_s[None, :] - dynamics[:, 2:3], 0.0) / dynamics[:, :1]
    zeta = dynamics[:, 1:2]
    gap = zeta * zeta - 1.0
    root = np.sqrt(np.where(np.abs(gap) < 1e-6, 1e-6, gap).astype(complex))
    p, q = -zeta + root, -zeta - root
    return np.real(1.0 + (q * np.exp(p * t) - p * np.exp(q * t)) / (p - q))


@dataclass(frozen=True)
class Discrete:
    """B(q)/A(q) from the drive of an interval to the mean torque of an interval, equations (1) to (3)."""

    b: tuple[float, ...]  # b0 … bn
    a: tuple[float, ...]  # 1, a1 … al
    delay_samples: int  # d, in pulse intervals
    step_s: float  # pulse interval, s
    centre: float = 0.0  # place of the mean within the interval, 0 to 1: 0 for one sample per pulse, near 0.5 for many

    @property
    def poles(self) -> np.ndarray:
        """Roots of A."""
        return np.roots(self.a)

    @property
    def stable(self) -> bool:
        """True if every pole is inside the unit circle."""
        return bool(np.all(np.abs(self.poles) < 1.0 - 1e-9))

    @property
    def memory_s(self) -> float:
        """Time after which the response to an impulse has fallen to about 1/1000, s."""
        slowest = min(float(np.max(np.abs(self.poles), initial=0.0)), 1.0 - 1e-6)
        decay = 7.0 / -np.log(slowest) if slowest > 0 else 0.0
        return self.step_s * (self.delay_samples + len(self.b) + decay)

    def on_grid(self, grid: Grid, drive_nm: np.ndarray) -> np.ndarray:
        """Interval means of the response from rest to a drive given on even slots, shape (K,), N·m."""
        mean_nm = grid.interval_means(drive_nm)
        if abs(grid.step_s - self.step_s) <= 1e-9:
            return self.filter(mean_nm)
        # On a grid with another pulse interval it runs at its own, and is then interpolated.
        time_s = np.arange(int(np.ceil(grid.size * grid.step_s / self.step_s))) * self.step_s
        source = np.clip(np.floor((time_s + 1e-9) / grid.step_s).astype(np.int64), 0, grid.size - 1)
        at = (np.arange(grid.size) + self.centre) * grid.step_s
        return np.interp(at, time_s + self.centre * self.step_s, self.filter(mean_nm[source]))

    def filter(self, drive_nm: np.ndarray) -> np.ndarray:
        """B(q)/A(q) applied along the first axis, from rest."""
        forced = np.zeros(drive_nm.shape, order="F")
        for lag, b in enumerate(self.b, start=self.delay_samples):
            forced[lag:] += b * drive_nm[: max(len(drive_nm) - lag, 0)]
        return recursion(np.array(self.a), forced)

    def between(self, grid: Grid, mean: np.ndarray) -> np.ndarray:
        """Interval means interpolated to the record's samples by a cubic through their centres, shape (N,)."""
        position = grid.interval + grid.fraction - self.centre
        if np.allclose(position, np.round(position), atol=1e-6):
            return mean[np.clip(np.round(position).astype(np.int64), 0, mean.size - 1)]
        slope = np.gradient(mean) / grid.step_s
        return grid.at_samples(np.r_[mean, mean[-1]], np.r_[slope, 0.0], self.centre)

    def discrete(self, sample_rate_hz: float) -> tuple[np.ndarray, np.ndarray, int]:  # noqa: ARG002
        """(b, a, d) at the pulse rate, the only rate at which this block is defined."""
        return np.array(self.b), np.array(self.a), self.delay_samples

    def step_response(self, time_s: np.ndarray) -> np.ndarray:
        """Response to a unit step at zero, linear between pulses."""
        time_s = np.asarray(time_s, float)
        size = int(np.ceil(max(float(np.max(time_s, initial=0.0)) / self.step_s, 1.0))) + 2
        return np.interp(time_s / self.step_s, np.arange(size) + self.centre, self.filter(np.ones(size)))

    def to_dict(self) -> dict:
        return {"kind": "discrete", "step_s": self.step_s, "centre": self.centre}


Linear = SecondOrder | Discrete


def linear_from_dict(data: dict) -> Linear:
    """The block that `to_dict` and the coefficients b, a, delay_samples describe."""
    if data["kind"] == "second-order":
        return SecondOrder(float(data["time_constant_s"]), float(data["damping"]), float(data["delay_s"]))
    return Discrete(
        b=tuple(float(x) for x in data["b"]),
        a=tuple(float(x) for x in data["a"]),
        delay_samples=int(data["delay_samples"]),
        step_s=float(data["step_s"]),
        centre=float(data["centre"]),
    )


NARX_LIMIT = 20.0
"""Scaled torque at which a diverging free run is stopped."""


def run_narx(recipe: dict[str, Any], width_us: np.ndarray) -> np.ndarray:
    """Free run from rest for one pulse width per interval, N·m above the baseline; limited if it diverges."""
    variables, terms, weights = recipe["variables"], recipe["terms"], recipe["weights"]
    width = (np.asarray(width_us, float) / recipe["width_scale_us"]).tolist()
    lead = max((lag for _, lag in variables), default=1)
    width, torque = [0.0] * lead + width, [0.0] * (lead + len(width))
    for k in range(lead, len(width)):
        value = [(torque if kind == 0 else width)[k - lag] for kind, lag in variables]
        total = 0.0
        for term, weight in zip(terms, weights, strict=True):
            product = weight
            for v in term:
                product *= value[v]
            total += product
        torque[k] = min(max(total, -NARX_LIMIT), NARX_LIMIT)
    return np.array(torque[lead:]) * recipe["torque_scale_nm"]
