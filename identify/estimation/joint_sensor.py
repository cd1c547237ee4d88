"""The sensor of the joint's angle, as a record shows it: its delay, found beside all other parameters, and its cost."""

from __future__ import annotations

import math

import numpy as np

from stimrig.identify.estimation.solve import Fitted, gram, knows_joint, solve, solve_scaled
from stimrig.identify.problem.predict import sensor_cost_nm
from stimrig.identify.problem.problem import Problem

LARGEST_S = 0.1
PRIOR_S = 0.02
"""Standard deviation of the delay before anything is known of it."""
SLOPE_S = 0.002
"""Over which the slope of the torque over the delay is taken."""
STEPS, SEARCH, SETTLED_S = 6, 8, 3e-4
LEAST_GAIN = 5.0
"""Log evidence that a delay must gain: a trifle is left to the other parameters."""


def with_angle_delay(base: Fitted) -> Fitted:
    """The model with the delay of the angle that explains its record best; as it is where hardly any is seen."""
    if not knows_joint(base):
        return base
    best = base
    for _ in range(STEPS):
        late_s, theta = _step(best)
        if abs(late_s - best.problem.setup.angle_late_s) < SETTLED_S:
            break
        problem = Problem(best.problem.setup.with_(angle_late_s=late_s), best.effects)
        refitted = solve(problem, theta, best.noise, max_steps=SEARCH)
        if not refitted.log_evidence > best.log_evidence:
            break
        best = refitted
    min_gain = 0.0 if base.problem.setup.angle_late_s else LEAST_GAIN
    return best if best.log_evidence > base.log_evidence + min_gain else base


def _step(fitted: Fitted) -> tuple[float, np.ndarray]:
    """Delay, s, and parameters after a Gauss-Newton step of both."""
    setup, late_s = fitted.problem.setup, fitted.problem.setup.angle_late_s
    later = Problem(setup.with_(angle_late_s=late_s + SLOPE_S), fitted.effects)
    slope = (later.run(fitted.theta)[0] - (setup.target_nm - fitted.residual_nm)) / SLOPE_S
    white = gram(setup.whitened(np.vstack([fitted.residual_nm, fitted.slopes, slope]), fitted.noise))
    mean, precision = fitted.problem.prior
    system, gradient = white[1:, 1:].copy(), white[0, 1:].copy()
    system[:-1, :-1] += precision
    system[-1, -1] += PRIOR_S**-2
    gradient[:-1] -= precision @ (fitted.theta - mean)
    gradient[-1] -= late_s / PRIOR_S**2
    step = solve_scaled(system, gradient)
    problem = fitted.problem
    theta = np.clip(fitted.theta + step[:-1], problem.lower, problem.upper)
    return float(np.clip(late_s + step[-1], -LARGEST_S, LARGEST_S)), theta


def sensor_of(fitted: Fitted) -> dict[str, float]:
    """Describe the angle's sensor for MODEL.json; empty where no effect of the model depends on the joint.

    `noise_rad`: what smoothing took off the angle, root mean square; `step_rad`: its steps, 0 where none are seen;
    `delay_s`; `cost_nm`: standard deviation of the torque owing to what error is left.
    """
    setup = fitted.problem.setup
    motion, record = setup.grid.record.motion, setup.grid.record
    if motion is None or not knows_joint(fitted):
        return {}
    return {
        "noise_rad": float(np.std(record.angle_rad - motion.angle_rad)),
        "step_rad": motion.step_rad,
        "delay_s": setup.angle_late_s,
        "cost_nm": sensor_cost_nm(fitted.problem, fitted.theta),
    }


def words(sensor: dict[str, float]) -> list[str]:
    """The same in words."""
    if not sensor:
        return []
    noise, cost = f"{math.degrees(sensor['noise_rad']):.2f}", f"{sensor['cost_nm']:.2g}"
    step, late = f"{math.degrees(sensor['step_rad']):.2g}", f"{1e3 * sensor['delay_s']:.0f}"
    sentences = [f"The angle strays by {noise}°; smoothed, that still costs {cost} N·m of torque."]
    if sensor["step_rad"]:
        sentences.append(f"The sensor tells the angle in steps of {step}°.")
    if sensor["delay_s"]:
        sentences.append(f"The sensor tells the angle {late} ms late.")
    return sentences
