"""Time between the pulse and the first torque."""

from __future__ import annotations

import numpy as np

from stimrig.identify.dynamics.variable_speed import activate
from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form


@form(
    "delay",
    "y(t - delay)",
    Parameter("delay_s", "s", 0.0, 0.15, 0.0, (0.02, 0.06), about="delay in addition to that of the linear dynamics"),
)
def delay(_: None, p: Values, _scene: Scene) -> np.ndarray:
    return p["delay_s"]


def _lagging(drive: np.ndarray, tau: np.ndarray, scene: Scene) -> np.ndarray:
    return activate(np.ascontiguousarray(drive), tau, tau, scene.step_s)


@form(
    "gain",
    "a' = (w - a)/lag: a distributed delay, one more pole",
    Parameter("lag_s", "s", 0.0, 0.12, 0.0, (0.03,), about="mean of the distributed delay"),
)
def lag(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return _lagging(drive, p["lag_s"][:, 0], scene)


@form(
    "gain",
    "three equal lags in series, lag in total",
    Parameter("lag_s", "s", 0.0, 0.2, 0.0, (0.06,), about="mean of the distributed delay"),
)
def chain(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    for _ in range(3):
        drive = _lagging(drive, p["lag_s"][:, 0] / 3.0, scene)
    return drive


@form(
    "gain",
    "a' = (w(t - delay) - a)/lag: fibres with different delays",
    Parameter("delay_s", "s", 0.0, 0.13, 0.0, (0.03,), about="smallest delay"),
    Parameter("lag_s", "s", 0.0, 0.12, 0.0, (0.02,), about="spread of the delays"),
)
def spread(drive: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    """A delay of any number of pulse intervals, then a lag."""
    steps = p["delay_s"] / scene.step_s
    late = drive
    for _ in range(6):
        part = np.clip(steps, 0.0, 1.0)
        late = late - part * (late - np.concatenate([np.zeros_like(late[:, :1]), late[:, :-1]], axis=1))
        steps = steps - part
    return _lagging(late, p["lag_s"][:, 0], scene)


EFFECT = Effect(
    id="electromechanical_delay",
    name="Electromechanical delay",
    forms=(delay, lag, chain, spread),
    signature="The model is too early at every change: the residual looks like the rate of the torque.",
    resembles=("series_compliance", "mixed_fibres", "asymmetric_relaxation"),
    separated_by="Single pulses, sampled at 400 Hz or faster.",
    plain="Some hundredths of a second pass between a pulse and its first torque. With a longer delay the controller "
    "must react more gently.",
    source="Sinclair et al.: quadriceps onset 31 ± 3 ms at 90°, 67 ± 24 ms at 15°; offset 58 ± 5 ms",
    main={"delay_s": "delay", "lag_s": "spread of the delays"},
)
