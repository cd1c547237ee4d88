"""Write a term of a model's free effect as a file of an own effect, which a person renames and edits."""

from __future__ import annotations

from typing import Any

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.terms import EDGE, LARGEST, QUICK_S, Driver, Place
from stimrig.identify.effects import find_effect
from stimrig.identify.errors import BadRequest
from stimrig.identify.model import Model

STAGES = {Place.WIDTH: "pulse_width", Place.STRENGTH: "gain", Place.TORQUE: "filter", Place.FACTOR: "filter"}
"""Stages of an own effect by places; a rate has none."""
ROWS = 17
"""Points of the recruitment curve."""
BENT = f"0.5 * (np.hypot({{0}}, {EDGE}) + {{0}} - {EDGE})"
"""A rate where it is positive, as the terms bend it."""
BEFORE = {
    Driver.DRIVE: "{share}",
    Driver.TORQUE: "torque",
    Driver.RISE: BENT.format(f"(torque - before) * {QUICK_S} / scene.step_s"),
    Driver.FALL: BENT.format(f"(before - torque) * {QUICK_S} / scene.step_s"),
    Driver.PULSES: "scene.acting[k]",
}
BEHIND = {
    Driver.DRIVE: "np.roll(np.interp(scene.pulse_width_us, WIDTHS_US, SHARES), 1)",
    Driver.TORQUE: "torque / scene.scale_nm",
    Driver.RISE: BENT.format(f"rate * {QUICK_S} / scene.scale_nm"),
    Driver.FALL: BENT.format(f"-rate * {QUICK_S} / scene.scale_nm"),
    Driver.PULSES: "np.roll(scene.acting, 1)",
    Driver.SQUARE: "(torque / scene.scale_nm) ** 2",
    Driver.TORQUE_PLAY: "torque / scene.scale_nm",
    Driver.WIDTH_PLAY: "np.roll(scene.pulse_width_us, 1) / scene.largest_us",
}
"""The driver of a term that acts before the lags, in one interval, and of one behind them, at all ends of intervals."""
FILE = '''\
"""{words}

Written by `stimrig explain --own`. Rename `id` and `name` to your hypothesis, edit `act`, `equation` and the words, and
name this file's folder in STIMRIG_EFFECTS_DIR (docs/add-an-effect.md).{note}"""

import numpy as np

from stimrig.effects import Effect, Form, Parameter
{constants}

def act({x}, p, scene):
{body}

EFFECT = Effect(
    id="own_{id}", name="Own: {name}", resembles={resembles},
    forms=(Form("term", "{stage}", "{equation}", ({parameters}), apply=act),),
    signature="{signature}",
    separated_by="{separated_by}",
    plain="Write here what a clinician should know.",
)
'''
LOOP = """\
    acting, first, torque, state = {x}.copy(), 0.0, 0.0, 0.0
    keep_1, keep_2, keep = (np.exp(-scene.step_s / lag_s) for lag_s in (*LAGS_S, p["lag_s"]))
    rested = np.exp(-scene.rest_s / p["lag_s"])
    for k in range({x}.size):
        acting[k] *= np.exp({bound} * np.tanh(p["change"] * state / {bound}))  # the term
        share = {acting}
        first = share + (first - share) * keep_1
        before, torque = torque, first + (torque - first) * keep_2
        now = {now}  # its driver
        state = now + (state * rested[k] - now) * keep
    return acting
"""
LAGGED = """\
    keep, rested = np.exp(-scene.step_s / p["lag_s"]), np.exp(-scene.rest_s / p["lag_s"])
    state = np.zeros(now.size)
    for k in range(1, now.size):
        state[k] = (now[k] + (state[k - 1] - now[k]) * keep) * rested[k]
"""
PLAY = """\
    state, anew = np.zeros(now.size), scene.begins if scene.begins is not None else np.zeros(now.size)
    for k in range(1, now.size):
        state[k] = np.clip(0.0 if anew[k - 1] else state[k - 1], now[k] - p["reach"], now[k] + p["reach"])
"""
RETURNS = {
    Place.TORQUE: '    return torque + scene.scale_nm * p["change"] * state, rate\n',
    Place.FACTOR: f'    factor = np.exp({LARGEST} * np.tanh(p["change"] * state / {LARGEST}))\n'
    "    return torque * factor, rate * factor\n",
}


def own_effect(model: Model) -> str:
    """Return the Python file of the first term of a model that an own effect can express.

    Raises BadRequest: the model has no term, or none that an own effect can express.
    """
    terms = [entry for entry in model.effects if "shape" in entry]
    written = [entry for entry in terms if _law(entry)[0] in STAGES]
    if not terms:
        raise BadRequest("no free effect was found: there is nothing to write")
    if not written:
        raise BadRequest("the free effect changes a rate, which no stage of an own effect can")
    entry = written[0]
    place, driver = _law(entry)
    described = find_effect(entry["id"])
    values = {name: value["value"] for name, value in entry["parameters"].items()}
    parameters = [f'\n        Parameter("change", "1", -3.0, 3.0, 0.0, ({values.pop("change"):.4g},)),']
    for name, value in values.items():
        unit, about = ("s", "time constant") if name == "lag_s" else ("1", "half of the play, a share")
        bounds = f"{value / 10.0:.4g}, {value * 10.0:.4g}, 0.0, ({value:.4g},)"
        parameters.append(f'\n        Parameter("{name}", "{unit}", {bounds}, "log", about="{about}"),')
    constants, note = "", ""
    if place in RETURNS:
        x = "x"
        state = "    state = now\n" if driver == Driver.SQUARE else PLAY if driver > Driver.SQUARE else LAGGED
        body = f"    torque, rate = x\n    now = {BEHIND[driver]}  # the driver\n{state}{RETURNS[place]}"
    else:
        x = "width_us" if place == Place.WIDTH else "drive_nm"
        value = "np.interp({}, WIDTHS_US, SHARES)" if place == Place.WIDTH else "{} / scene.scale_nm"
        now = BEFORE[driver].format(share=value.format(f"{x}[k]"))
        body = LOOP.format(x=x, acting=value.format("acting[k]"), now=now, bound=LARGEST)
        assert isinstance(model.linear, SecondOrder)
        spread = np.sqrt(max(model.linear.damping**2 - 1.0, 0.0))
        lags_s = [model.linear.time_constant_s * (model.linear.damping + side * spread) for side in (-1.0, 1.0)]
        constants = f"\nLAGS_S = {lags_s[0]:.4g}, {lags_s[1]:.4g}"
        note = "\nHere the drive behind the model's two lags stands in for the torque, which this stage cannot see."
    if "SHARES" in body:
        widths_us = np.linspace(0.0, float(model.recruitment.basis.largest_us), ROWS)
        shares = np.abs(model.recruitment(widths_us)) / entry["settings"]["scale_nm"]
        constants += f"\nWIDTHS_US = np.linspace(0.0, {widths_us[-1]:g}, {ROWS})\nSHARES = {shares.round(3).tolist()}"
    if len(terms) > 1:
        note += f"\nIts values are from the fit with all {len(terms)} terms together."
    return FILE.format(
        words=entry["shape"]["words"],
        note=note,
        constants=f"{constants}\n" if constants else "",
        x=x,
        body=body,
        id=entry["id"].removeprefix("free_"),
        name=described.name,
        stage=STAGES[place],
        equation=entry["equation"],
        parameters=f"{''.join(parameters)}\n    ",
        signature=described.signature,
        resembles=tuple(entry["shape"]["behaves_as"]),
        separated_by=described.separated_by,
    )


def _law(entry: dict[str, Any]) -> tuple[Place, Driver]:
    law = find_effect(entry["id"]).forms[0].law
    return Place(int(law["place"])), Driver(int(law["driver"]))
