"""A free effect: two parallel ways, quick and slow, each with its own curve and its own use."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Shape, Values, adapt, form
from stimrig.identify.effects.use import percent, seconds

LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
AT = np.linspace(0.0, 1.0, 41)
_SHARES = tuple(f"share_{round(100 * level)}" for level in LEVELS)


def _share(level: np.ndarray, p: Values) -> np.ndarray:
    """The slow way's share, linear between `LEVELS`; `p` as `apply` takes it."""
    place = level * (len(LEVELS) - 1)
    first = np.minimum(place.astype(np.int64), len(LEVELS) - 2)
    known = np.concatenate([np.atleast_2d(p[name]).reshape(-1, 1) for name in _SHARES], axis=1)
    row = np.arange(len(known))[:, None]
    return known[row, first] + (place - first) * (known[row, first + 1] - known[row, first])


@form(
    "branch",
    "y = G(T) (1 - s) f (1 - loss_quick·x1) + G(ratio·T) s f (1 - loss_slow·x2); s linear between five levels of f; "
    "x' = a (1 - x)/fill - (1 - a) x/empty, a: the way's own drive",
    *(
        Parameter(
            share_name,
            "1",
            0.0,
            1.0,
            0.0,
            (0.3, 0.6),
            about=f"share of the slow way at {100 * level:.0f} % of the level",
        )
        for share_name, level in zip(_SHARES, LEVELS, strict=True)
    ),
    Parameter("ratio", "1", 1.2, 12.0, 1.0, (2.0, 4.0), "log", about="slow time constant over the quick one"),
    Parameter("loss_quick", "1", -0.9, 0.95, 0.0, (0.1,), about="share that the quick way loses with use"),
    Parameter("loss_slow", "1", -0.9, 0.95, 0.0, (0.0,), about="share that the slow way loses with use"),
    Parameter("fill_s", "s", 1.0, 100.0, 0.0, (5.0,), "log", about="time constant under full work"),
    Parameter("empty_s", "s", 2.0, 200.0, 0.0, (20.0,), "log", about="time constant at rest"),
)
def parallel(drive: np.ndarray, p: Values, scene: Scene) -> list:
    share = _share(np.clip(np.abs(drive) / scene.scale_nm, 0.0, 1.0), p)
    branches = []
    for way_drive, loss, slower in (
        ((1.0 - share) * drive, p["loss_quick"], np.ones_like(p["ratio"])),
        (share * drive, p["loss_slow"], p["ratio"]),
    ):
        if np.any(loss):
            use = np.minimum(np.abs(way_drive) / scene.scale_nm, 1.0)
            way_drive = way_drive * (
                1.0 - loss * adapt(use, p["fill_s"][:, 0], p["empty_s"][:, 0], False, scene.step_s, scene.rest_s)[0]
            )
        branches.append((way_drive, slower))
    return branches


def _shape(_form: Form, values: Mapping[str, float]) -> Shape:
    share = _share(AT[None, :], dict(values))[0]
    tires = max(abs(values["loss_quick"]), abs(values["loss_slow"])) > 0.2
    words = (
        f"A way that is {values['ratio']:.2g} times slower carries {100.0 * share[20]:.0f} % at half of the torque; "
        f"full use changes the quick way by {percent(-values['loss_quick'])} and the slow one by "
        f"{percent(-values['loss_slow'])}, with a time constant of {seconds(values['fill_s'])}."
    )
    lines = {"slow way": share, "quick way": 1.0 - share}
    where = ("drive", "sum of the past") if tires else ("rate of fall", "width")
    return Shape(*where, words, "level of recruitment (share of the largest)", AT, "share of the torque", lines)


EFFECT = Effect(
    id="free_ways",
    name="Two ways in parallel, each with its own curve",
    forms=(parallel,),
    signature="A quick and a slow part, in proportions that change with the level and with use.",
    resembles=("mixed_fibres", "fatigue", "free_strength", "free_zero"),
    separated_by="Long steps at several levels, before and after work.",
    plain="Two parts of the muscle act side by side, one slower than the other: the picture shows which part carries "
    "how much. No effect of the library describes it.",
    source="cf. Burke 1973; two branches with curves of their own",
    main={"ratio": "ratio"},
    shape=_shape,
)
