"""Time between the pulse and the first torque."""

from __future__ import annotations

import numpy as np
from numba import njit

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form


@form(
    "delay",
    "y(t - delay)",
    Parameter("delay_s", "s", 0.0, 0.15, 0.0, (0.02, 0.06), about="delay in addition to that of the linear dynamics"),
)
def delay(_: None, p: Values, _scene: Scene) -> np.ndarray:
    return p["delay_s"]


@njit(cache=True, nogil=True)
def _lagging(drive, lag_s, step_s):  # pragma: no cover
    """Mean over each interval of a, from 0; a' = (w - a)/lag; shapes (M, K), (M,). With a lag of 0, a is w."""
    out = np.empty(drive.shape)
    for m in range(len(drive)):
        a, decay = 0.0, np.exp(-step_s / lag_s[m]) if lag_s[m] > 0.0 else 0.0
        for k in range(drive.shape[1]):
            w = drive[m, k]
            out[m, k] = w + (a - w) * (1.0 - decay) * lag_s[m] / step_s
            a = w + (a - w) * decay
    return out


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
    return _lagging(np.ascontiguousarray(late), p["lag_s"][:, 0], scene.step_s)


EFFECT = Effect(
    id="electromechanical_delay",
    name="Electromechanical delay",
    forms=(delay, spread),
    signature="The model is too early at every change: the residual looks like the rate of the torque.",
    resembles=("series_compliance", "mixed_fibres", "asymmetric_relaxation"),
    separated_by="Single pulses, sampled at 400 Hz or faster.",
    plain="Some hundredths of a second pass between a pulse and its first torque. With a longer delay the controller "
    "must react more gently.",
    source="Sinclair et al.: quadriceps onset 31 ± 3 ms at 90°, 67 ± 24 ms at 15°; offset 58 ± 5 ms",
    main={"delay_s": "delay", "lag_s": "spread of the delays"},
)
