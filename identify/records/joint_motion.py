"""Motion of the joint: angle, velocity and acceleration from a noisy angle, by a Kalman filter with white jerk.

A velocity that is recorded beside an angle is a slope of the same noisy readings: the angle alone decides. Each part of
a record has its own intensity of the jerk, and its own noise, by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numba import njit

MOTION = ("angle_rad", "velocity_rad_s", "acceleration_rad_s2")
BLOCK_S = 0.01
"""Readings so close together are averaged where noise is estimated: a column that was interpolated between them shows
little of the noise from row to row."""
UNKNOWN, AT_REST = 1e14, 1e3
"""Variance of a state before anything is measured, over that of the noise: it may be whatever it is; or, where there
are no later readings, the joint begins about at rest."""
LEAST_BLOCKS = 8
LEAST_NOISE_RAD = 2e-6
"""Even an angle without noise is written with so many digits."""
RATIOS = tuple(np.linspace(np.log(1e-3), np.log(1e14), 30).tolist())
"""Logarithms of the jerk's intensity over the noise's variance, 1/s⁵, between which the likeliest is sought."""
HELD_S = 0.1
"""A first or last reading that is repeated for less was there once: a reader continues a column by it."""
GOLDEN, SEARCHES = 0.381966, 10
PLATEAU = 3
"""So many equal angles in a row are one step of the sensor, also where a column was interpolated."""
LEAST_STEPS, WHOLE = 5, 0.05
"""Different plateaus from which steps are seen, and by how much of one their distances may miss a whole number."""
FEW_STEPS, RESTS = 6.5, 0.8
"""A joint that moves over no more steps, and whose angle is the one before in such a share of readings, is held:
when it went from one step to the next says nothing of its velocity."""
STEADY = (0.0, 0.0)
"""Pace of a movement with nothing but white jerk."""
PACES = ((0.3, 3.0, 30.0), (0.3,))
"""Starting values of the search for the pace, 1/s² and 1/s."""
PIECE, LONG_GAP_S = 0.2, 1.0
"""The series of a step is taken in pieces of so little of a pace; over a longer gap nothing is predicted."""
LOGS = (-9.0, -9.0, -9.0), (12.0, 9.0, 6.0)
"""Logarithms of the jerk's intensity, rad²/s⁵, and of the pace: no joint swings at over 14 Hz."""
SETTLED = {"maxiter": 120, "xatol": 0.03, "fatol": 0.3}
UNIFORM = 1.0 / np.sqrt(12.0)
"""Standard deviation of what lies evenly within a step."""
LARGEST_STEP_RAD = 0.035


@njit(cache=True, nogil=True)
def _forward(time_s, angle_rad, noise, jerk, pace, unknown, states, spreads, innovations):  # pragma: no cover
    """Kalman filter of (angle, velocity, acceleration); a reading that is NaN is left out.

    The jerk is white, less `pace[0]` times the velocity and `pace[1]` times the acceleration. Writes the filtered
    `states` (N, 3), `spreads` (N, 6): their covariance; `innovations` (N, 5): innovation, its variance, gains. Returns
    the sum of log variances and of squared innovations over their variance, and the count.
    """
    store_states = states.shape[0] > 0
    x, v, a = 0.0, 0.0, 0.0
    for k in range(time_s.size):
        if angle_rad[k] == angle_rad[k]:
            x = angle_rad[k]
            break
    wide = unknown * noise[0]
    pxx, pxv, pxa, pvv, pva, paa = wide, 0.0, 0.0, wide, 0.0, 100.0 * wide
    logs, squares, count = 0.0, 0.0, 0
    for k in range(time_s.size):
        apart = time_s[k] - time_s[k - 1] if k else 0.0
        pieces = int(np.ceil(apart * max(np.sqrt(pace[0]), pace[1]) / PIECE)) if apart < LONG_GAP_S else 1
        t = apart / max(pieces, 1)
        for _ in range(max(pieces, 1) if k else 0):
            # F = [[1, xv, xa], [0, vv, va], [0, av, aa]], its series in t, which ends where the pace is 0
            xv = t - pace[0] * t**3 / 6.0 + pace[0] * pace[1] * t**4 / 24.0
            xa = 0.5 * t * t - pace[1] * t**3 / 6.0 + (pace[1] ** 2 - pace[0]) * t**4 / 24.0
            va = t - pace[1] * t * t / 2.0 + (pace[1] ** 2 - pace[0]) * t**3 / 6.0
            vv = 1.0 - pace[0] * xa
            av, aa = -pace[0] * va, vv - pace[1] * va
            x, v, a = x + xv * v + xa * a, vv * v + va * a, av * v + aa * a
            # F P F', and what white jerk adds over t
            bx, bv, ba = pxx + xv * pxv + xa * pxa, pxv + xv * pvv + xa * pva, pxa + xv * pva + xa * paa
            cv, ca, dv, da = vv * pvv + va * pva, vv * pva + va * paa, av * pvv + aa * pva, av * pva + aa * paa
            pxx = bx + xv * bv + xa * ba + jerk * t**5 / 20.0
            pxv = vv * bv + va * ba + jerk * t**4 / 8.0
            pxa = av * bv + aa * ba + jerk * t**3 / 6.0
            pvv = vv * cv + va * ca + jerk * t**3 / 3.0
            pva = av * cv + aa * ca + jerk * t * t / 2.0
            paa = av * dv + aa * da + jerk * t
        e, s, gx, gv, ga = 0.0, 0.0, 0.0, 0.0, 0.0
        if angle_rad[k] == angle_rad[k]:
            e, s = angle_rad[k] - x, pxx + noise[k]
            gx, gv, ga = pxx / s, pxv / s, pxa / s
            if count > 3:  # earlier innovations depend on the start alone
                logs += np.log(s)
                squares += e * e / s
            count += 1
            x, v, a = x + gx * e, v + gv * e, a + ga * e
            paa -= ga * pxa
            pva -= gv * pxa
            pvv -= gv * pxv
            pxx, pxv, pxa = pxx * (1.0 - gx), pxv * (1.0 - gx), pxa * (1.0 - gx)
        if store_states:
            states[k, 0], states[k, 1], states[k, 2] = x, v, a
            spreads[k, 0], spreads[k, 1], spreads[k, 2] = pxx, pxv, pxa
            spreads[k, 3], spreads[k, 4], spreads[k, 5] = pvv, pva, paa
            innovations[k, 0], innovations[k, 1] = e, s
            innovations[k, 2], innovations[k, 3], innovations[k, 4] = gx, gv, ga
    return logs, squares, max(count - 4, 0)


@njit(cache=True, nogil=True)
def _backward(time_s, states, spreads, innovations):  # pragma: no cover
    """Smooth the filtered states in place by the later readings (Bryson and Frazier's smoother)."""
    lx, lv, la = 0.0, 0.0, 0.0
    for k in range(time_s.size - 1, -1, -1):
        xx, xv, xa, vv, va, aa = spreads[k]
        states[k, 0] -= xx * lx + xv * lv + xa * la
        states[k, 1] -= xv * lx + vv * lv + va * la
        states[k, 2] -= xa * lx + va * lv + aa * la
        e, s, gx, gv, ga = innovations[k]
        if s > 0.0:
            lx -= gx * lx + gv * lv + ga * la + e / s
        if k:
            t = time_s[k] - time_s[k - 1]
            lv, la = lv + t * lx, la + t * lv + 0.5 * t * t * lx


NO_STATES = tuple(np.empty((0, width)) for width in (3, 6, 5))
"""In place of what `_forward` writes, where only the likelihood is asked for."""
Pace = tuple[float, float]
"""Feedback of velocity and acceleration on the jerk, 1/s² and 1/s."""


@dataclass(frozen=True)
class JointMotion:
    """Motion of the joint, with the noise and the step of its sensor."""

    angle_rad: np.ndarray  # shape (N,), as the next two; at the record's samples
    velocity_rad_s: np.ndarray
    acceleration_rad_s2: np.ndarray
    noise_rad: np.ndarray  # shape (P,); white noise of a sample's angle in each part, rad
    jerk: np.ndarray  # shape (P,); intensity of the white jerk in each part, rad²/s⁵
    step_rad: float = 0.0  # resolution of the angle sensor, rad; 0 where none is visible

    @classmethod
    def of(cls, time_s: np.ndarray, angle_rad: np.ndarray, first: Sequence[int] = (0,)) -> JointMotion:
        """From angles, of which any may be NaN; each part, from its `first` reading on, by itself."""
        parts = [slice(a, b) for a, b in pairwise([*first, time_s.size])]
        step_rad = step_of([angle_rad[part] for part in parts])
        read_rad = np.concatenate([_without_held(time_s[part], angle_rad[part]) for part in parts])
        noise_rad, jerk = np.array([sensor_of(time_s[part], read_rad[part], step_rad) for part in parts]).T
        return cls(read_rad, read_rad, read_rad, noise_rad, jerk, step_rad)._smoothed(time_s, read_rad, first)

    @classmethod
    def until_then(
        cls, time_s: np.ndarray, angle_rad: np.ndarray, first: Sequence[int], earlier: tuple[np.ndarray, np.ndarray]
    ) -> JointMotion:
        """At each reading from those until then alone, as a controller has them.

        Sensor noise and the pace of the movement are estimated from times and angles of an `earlier` trial.
        """
        at_s, read_rad = earlier[0], _without_held(*earlier)
        step_rad = step_of([read_rad])
        noise_rad, jerk = sensor_of(at_s, read_rad, step_rad)
        jerk, pace = pace_of(at_s, read_rad, noise_rad, jerk)
        noises_rad, jerks = np.full((2, len(first)), [[noise_rad], [jerk]])
        begun = cls(angle_rad, angle_rad, angle_rad, noises_rad, jerks, step_rad)
        return begun._smoothed(time_s, angle_rad, first, pace)

    def read_again(self, time_s: np.ndarray, first: Sequence[int]) -> JointMotion:
        """The same movement with a new draw of the sensor's noise, to see the effect of its error on a model."""
        noise_rad = np.repeat(self.noise_rad, np.diff([*first, time_s.size]))
        noise_rad = noise_rad * np.random.default_rng(0).normal(size=time_s.size)
        return self._smoothed(time_s, self.angle_rad + noise_rad, first)

    def extrapolated(self, late_s: float) -> JointMotion:
        """The motion `late_s` later, by velocity and acceleration: corrects for a sensor that reports late."""
        angle, velocity, acceleration = (getattr(self, name) for name in MOTION)
        on = angle + late_s * velocity + 0.5 * late_s**2 * acceleration
        return replace(self, angle_rad=on, velocity_rad_s=velocity + late_s * acceleration)

    def _smoothed(
        self, time_s: np.ndarray, read_rad: np.ndarray, first: Sequence[int], pace: Pace | None = None
    ) -> JointMotion:
        parts = [slice(a, b) for a, b in pairwise([*first, time_s.size])]
        sensors = zip(parts, self.noise_rad, self.jerk, strict=True)
        states = [smooth(time_s[part], read_rad[part], noise, jerk, pace) for part, noise, jerk in sensors]
        angle, velocity, acceleration = np.concatenate(states).T.copy()
        return replace(self, angle_rad=angle, velocity_rad_s=velocity, acceleration_rad_s2=acceleration)


def smooth(
    time_s: np.ndarray, angle_rad: np.ndarray, noise_rad: float, jerk: float, pace: Pace | None = None
) -> np.ndarray:
    """Angle, velocity and acceleration at each reading, shape (N, 3): from all readings; with a pace from those until
    then."""
    size = time_s.size
    states, spreads, innovations = np.empty((size, 3)), np.empty((size, 6)), np.empty((size, 5))
    noise, unknown = np.full(size, noise_rad**2), UNKNOWN if pace is None else AT_REST
    _forward(time_s, angle_rad, noise, jerk, pace or STEADY, unknown, states, spreads, innovations)
    if pace is None:
        _backward(time_s, states, spreads, innovations)
    return states


def pace_of(time_s: np.ndarray, angle_rad: np.ndarray, noise_rad: float, jerk: float) -> tuple[float, Pace]:
    """Intensity of the jerk and pace that make one part's angles most likely beside a sensor's noise."""
    from scipy.optimize import minimize  # here: its import takes longer than a fit, which mostly does not need it

    known = np.isfinite(angle_rad)
    at_s, read_rad = time_s[known], angle_rad[known]
    every = max(int(BLOCK_S / max(np.median(np.diff(at_s)), 1e-9)), 1) if at_s.size > LEAST_BLOCKS else 1
    at_s, read_rad = at_s[::every], read_rad[::every]
    noise = np.full(at_s.size, noise_rad**2)

    def deviance(logs: np.ndarray) -> float:
        intensity, spring, drag = np.exp(np.clip(logs, *LOGS))
        spread, squares, _ = _forward(at_s, read_rad, noise, intensity, (spring, drag), UNKNOWN, *NO_STATES)
        return spread + squares

    if not jerk > 0.0 or at_s.size <= LEAST_BLOCKS:
        return jerk, STEADY
    begins = [np.log([jerk, spring, drag]) for spring in PACES[0] for drag in PACES[1]]
    fits = [minimize(deviance, begin, method="Nelder-Mead", options=SETTLED) for begin in begins]
    best_fit = min(fits, key=lambda fit: fit.fun)
    steady = _forward(at_s, read_rad, noise, jerk, STEADY, UNKNOWN, *NO_STATES)
    if not best_fit.fun < steady[0] + steady[1]:
        return jerk, STEADY
    intensity, spring, drag = np.exp(np.clip(best_fit.x, *LOGS)).tolist()
    return intensity, (spring, drag)


def sensor_of(time_s: np.ndarray, angle_rad: np.ndarray, step_rad: float = 0.0) -> tuple[float, float]:
    """Noise of a reading, rad, and intensity of the jerk, rad²/s⁵, that make one part's angles most likely.

    The noise is at least that of even places within a step: what rests on one step shows none.
    """
    known = np.isfinite(angle_rad)
    at_s, read_rad = time_s[known], angle_rad[known]
    block = np.floor((at_s - at_s[:1]) / BLOCK_S + 1e-3)  # no rounding of times decides
    first = np.flatnonzero(np.diff(block, prepend=-1.0) > 0)
    count = np.diff(np.r_[first, at_s.size])
    least_variance = max(LEAST_NOISE_RAD, UNIFORM * step_rad) ** 2
    if first.size <= LEAST_BLOCKS or (
        # held: the angle rests and moves over a few steps of the sensor only
        np.ptp(read_rad) <= FEW_STEPS * step_rad and np.mean(np.diff(read_rad) == 0) > RESTS
    ):
        return float(np.sqrt(least_variance)), 0.0
    at_s, mean_rad = np.add.reduceat(at_s, first) / count, np.add.reduceat(read_rad, first) / count

    def profile_deviance(log_ratio: float) -> tuple[float, float, float]:
        ratio = float(np.exp(log_ratio))
        logs, squares, readings = _forward(at_s, mean_rad, 1.0 / count, ratio, STEADY, UNKNOWN, *NO_STATES)
        variance = max(squares / readings, least_variance)
        return logs + readings * np.log(variance) + squares / variance, log_ratio, variance

    at = int(np.argmin([profile_deviance(ratio)[0] for ratio in RATIOS]))
    low, high = RATIOS[max(at - 1, 0)], RATIOS[min(at + 1, len(RATIOS) - 1)]
    for _ in range(SEARCHES):
        sooner, later = low + GOLDEN * (high - low), high - GOLDEN * (high - low)
        low, high = (low, later) if profile_deviance(sooner) < profile_deviance(later) else (sooner, high)
    _, log_ratio, variance = profile_deviance(0.5 * (low + high))
    return float(np.sqrt(variance)), float(np.exp(log_ratio) * variance)


def step_of(parts_rad: Sequence[np.ndarray]) -> float:
    """Estimate the resolution of the angles, rad, from their plateaus; 0 where none is visible."""
    levels = []
    for angle_rad in parts_rad:
        ends = np.flatnonzero(np.diff(angle_rad, append=np.nan) != 0)
        levels.append(angle_rad[ends[np.diff(ends, prepend=-1) >= PLATEAU]])
    apart: np.ndarray = np.diff(np.sort(np.concatenate(levels)))
    apart = apart[apart > 2 * LEAST_NOISE_RAD]
    if apart.size < LEAST_STEPS - 1:
        return 0.0
    whole = np.round(apart / np.min(apart))
    step_rad = float(np.median(apart / whole))
    even = np.all(np.abs(apart / step_rad - whole) < WHOLE)
    return step_rad if even and step_rad < LARGEST_STEP_RAD else 0.0


def _without_held(time_s: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """The angles, NaN where a part's first or last reading was only repeated for a while where there was none."""
    without_held, moved = angle_rad, np.flatnonzero(angle_rad[1:] != angle_rad[:-1])
    if moved.size:
        first, last = moved[0], moved[-1] + 1
        without_held = angle_rad.copy()
        if time_s[first] - time_s[0] < HELD_S:
            without_held[:first] = np.nan
        if time_s[-1] - time_s[last] < HELD_S:
            without_held[last + 1 :] = np.nan
    return without_held
