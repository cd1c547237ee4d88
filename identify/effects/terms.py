"""Free effects: terms *place <- driver, late by τ*; they describe what no other effect explains, and name no cause."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.terms import LARGEST, Driver, Place
from stimrig.identify.effects.base import Effect, Form, Parameter, Shape

PLACES = {
    Place.WIDTH: ("width that acts", "u exp(z)"),
    Place.STRENGTH: ("strength", "f(u) exp(z)"),
    Place.FIRST_RATE: ("rate of the first lag", "1/T1 exp(z)"),
    Place.SECOND_RATE: ("rate of the second lag", "1/T2 exp(z)"),
    Place.TORQUE: ("torque at the cell", "y + y_max z"),
    Place.FACTOR: ("factor of the torque at the cell", "y exp(z)"),
}
"""Of each place its name, and how an exponent z acts there."""
DRIVERS = {
    Driver.DRIVE: ("drive", "f(u)/y_max"),
    Driver.TORQUE: ("torque", "y/y_max"),
    Driver.RISE: ("rise of the torque", "max(y', 0)·0.1 s/y_max"),
    Driver.FALL: ("fall of the torque", "max(-y', 0)·0.1 s/y_max"),
    Driver.PULSES: ("presence of pulses", "1 under pulses"),
    Driver.SQUARE: ("square of the torque", "(y/y_max)²"),
    Driver.TORQUE_PLAY: ("torque with play", "y/y_max"),
    Driver.WIDTH_PLAY: ("width with play", "u/u_max"),
}
"""Of each driver its name, and what it is."""
LAGS_S, REACHES = (0.08, 0.25, 0.8, 2.5, 8.0, 25.0), (0.05, 0.12, 0.3)
"""Lags, and reaches of a play, at which a term is looked for; then they are refined."""
SLOW_S = 5.0
"""Lag from which a term is one of use, not of the answer to single pulses."""
LEVEL = np.linspace(0.0, 1.0, 41)


def longest_s(place: Place) -> float:
    """Largest lag of a term: an added torque that is slower cannot be told from a zero that moves."""
    return 10.0 if place == Place.TORQUE else 30.0


def later(driver: Driver) -> bool:
    """Return True if a driver acts through a lag."""
    return driver < Driver.SQUARE


def tried_at(form: Form) -> tuple[float, ...]:
    """Lags or reaches at which a term is looked for; one number that says nothing where it has neither."""
    if not form.parameters[1:]:
        return (1.0,)
    return tuple(
        value
        for value in (LAGS_S if form.parameters[1].name == "lag_s" else REACHES)
        if value <= form.parameters[1].upper
    )


def percent(place: Place, exponent: float) -> str:
    """How an exponent changes its place, in percent; of an added torque, of the largest torque."""
    change = exponent if place == Place.TORQUE else np.expm1(LARGEST * np.tanh(exponent / LARGEST))
    return f"{100.0 * change:+.2g} %"


def _seconds(value_s: float) -> str:
    return f"{value_s:.2g} s" if value_s < 100.0 else f"{value_s / 60.0:.2g} min"


def _shape(form: Form, values: Mapping[str, float]) -> Shape:
    place, driver = Place(int(form.law["place"])), Driver(int(form.law["driver"]))
    size, where, what = values["change"], PLACES[place][0], DRIVERS[driver][0]
    whole = "a rise by the largest torque in 0.1 s" if driver in (Driver.RISE, Driver.FALL) else f"full {what}"
    words = f"{where.capitalize()} <- {what}: {percent(place, size)} at {whole}"
    axis = "torque added (share of the largest)" if place == Place.TORQUE else f"{where} (factor)"
    if later(driver):
        lag_s = values["lag_s"]
        at, rising = 4.0 * lag_s * LEVEL, LEVEL < 0.5
        state = np.where(rising, -np.expm1(-at / lag_s), -np.expm1(-2.0) * np.exp(2.0 - at / lag_s))
        words, lines = f"{words}, {_seconds(lag_s)} late", {"change": state}
        along = f"time, full {what} for {_seconds(2.0 * lag_s)}, then none (s)"
    elif driver == Driver.SQUARE:
        at, lines, along = LEVEL, {"change": LEVEL**2}, "torque (share of the largest)"
    else:
        reach = values["reach"]
        words += f", behind a play of {100.0 * reach:.2g} %"
        lines = {"rising": np.maximum(LEVEL - reach, 0.0), "falling": np.minimum(LEVEL + reach, 1.0 - reach)}
        at, along = LEVEL, f"{what.removesuffix(' with play')} (share of the largest)"
    drawn = {
        name: size * x if place == Place.TORQUE else np.exp(LARGEST * np.tanh(size * x / LARGEST))
        for name, x in lines.items()
    }
    return Shape(where, what, f"{words}.", along, at, axis, drawn)


def _term(place: Place, driver: Driver) -> Effect:
    where, acts = PLACES[place]
    what, is_ = DRIVERS[driver]
    parameters = [Parameter("change", "1", -3.0, 3.0, about="exponent z at the full driver, held")]
    law = {"place": place, "driver": driver, "lag": 1.0}
    if later(driver):
        parameters.append(Parameter("lag_s", "s", 0.02, longest_s(place), 0.0, (0.25,), "log", about="time constant"))
        equation = f"{acts}; z = change·x, x' = (d - x)/lag_s; d = {is_}"
    elif driver == Driver.SQUARE:
        equation = f"{acts}; z = change·{is_}"
    else:
        parameters.append(Parameter("reach", "1", 0.01, 0.6, 0.0, (0.12,), "log", about="half of the play, a share"))
        equation = f"{acts}; z = change·x, x follows {is_} behind a play of ±reach"
    return Effect(
        id=f"free_{place.name.lower()}_by_{driver.name.lower()}",
        name=f"{place.name} by {driver.name}".replace("_", " ").capitalize(),
        forms=(Form("term", "term", equation, tuple(parameters), law=law),),
        signature=f"The error follows the {what}, as if the {where} changed with it.",
        resembles=(),
        separated_by="Levels held for times about the lag, and rests as long.",
        plain=f"The {where} changes with the {what}: the picture shows by how much and how late. No effect of the "
        "library describes it.",
        source="a term of a first-order change; cf. play of Prandtl and Ishlinskii",
        shape=_shape,
    )


EFFECTS = tuple(_term(place, driver) for place in Place for driver in Driver if later(driver) or place >= Place.TORQUE)
