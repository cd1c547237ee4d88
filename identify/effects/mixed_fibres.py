"""Fast and slow fibres in parallel."""

from __future__ import annotations

import numpy as np

from stimrig.identify.effects.base import Effect, Parameter, Scene, Values, form

_SHARE = Parameter("slow_share", "1", 0.0, 0.9, 0.0, (0.3, 0.15), about="share of torque from the slow fibres")
_RATIO = Parameter("ratio", "1", 1.4, 12.0, 2.0, (2.0, 4.0), "log", about="slow time constant divided by fast")


@form("branch", "y = (1 - s) G(T) f + s G(ratio·T) f", _SHARE, _RATIO)
def parallel(drive: np.ndarray, p: Values, _scene: Scene) -> list:
    share = p["slow_share"]
    return [((1.0 - share) * drive, np.ones_like(share)), (share * drive, p["ratio"])]


@form(
    "branch",
    "as parallel, with s = slow_share·(f/f_max)^order: slow fibres are recruited late (order > 0) or early",
    _SHARE,
    _RATIO,
    Parameter("order", "1", -0.9, 3.0, 0.0, (1.0, -0.4), about="order of recruitment"),
)
def ordered(drive: np.ndarray, p: Values, scene: Scene) -> list:
    level = np.minimum(np.abs(drive) / scene.scale_nm, 1.0) + 1e-9
    share = np.minimum(p["slow_share"] * level ** p["order"], 1.0)
    return [((1.0 - share) * drive, np.ones_like(p["ratio"])), (share * drive, p["ratio"])]


EFFECT = Effect(
    id="mixed_fibres",
    name="Fast and slow fibres in parallel",
    forms=(parallel, ordered),
    signature="After every step a fast part of the response, then a long tail.",
    resembles=("electromechanical_delay", "asymmetric_relaxation", "baseline_drift", "activation_dependent_speed"),
    separated_by="One long step.",
    plain="The muscle has fast and slow fibres: after a step the torque first rises fast, then slowly for a while.",
    source="Parallel fast and slow branches; cf. Ding et al. 2003 for the two fibre types' time constants",
    prior=-1.5,
    main={"slow_share": "share of slow fibres"},
)
