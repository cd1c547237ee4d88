"""Free effects: terms *place <- driver, late by τ*; they describe what no other effect explains, and name no cause."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from stimrig.identify.dynamics.terms import EDGE, LARGEST, QUICK_S, Driver, Place
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
ROUNDED = f"(√(r² + {EDGE}²) + r - {EDGE})/2"
"""max(r, 0) with the corner that the model rounds."""
RATES_IN_WORDS = {Driver.RISE: f"; r = y'·{QUICK_S} s/y_max", Driver.FALL: f"; r = -y'·{QUICK_S} s/y_max"}
DRIVERS = {
    Driver.DRIVE: ("drive", "f(u)/y_max", "at full drive"),
    Driver.TORQUE: ("torque", "y/y_max", "at full torque"),
    Driver.RISE: ("rise of the torque", ROUNDED, "at a rise by the largest torque in 0.1 s"),
    Driver.FALL: ("fall of the torque", ROUNDED, "at a fall by the largest torque in 0.1 s"),
    Driver.PULSES: ("presence of pulses", "(1 under pulses)", "under pulses"),
    Driver.SQUARE: ("square of the torque", "(y/y_max)²", "at full torque"),
    Driver.TORQUE_PLAY: ("torque with play", "y/y_max", "at full torque"),
    Driver.WIDTH_PLAY: ("width with play", "u/u_max", "at the largest width"),
}
"""Of each driver its name, what it is as a share, and where it is 1."""
LAGS_S, REACHES = (0.08, 0.25, 0.8, 2.5, 8.0, 25.0), (0.05, 0.12, 0.3)
"""Lags, and reaches of a play, at which a term is looked for; then they are refined."""
USE, RATES = (Driver.DRIVE, Driver.TORQUE, Driver.PULSES), (Place.FIRST_RATE, Place.SECOND_RATE)
AFTER_LAGS = (Place.TORQUE, Place.FACTOR)
BEHAVIOURS: tuple[tuple[str, Sequence[Place], Sequence[Driver], float, float, int], ...] = (
    ("fatigue", (Place.STRENGTH, Place.FACTOR), USE, 5.0, 60.0, -1),
    ("potentiation", (Place.STRENGTH, Place.FACTOR), USE, 2.5, 60.0, 1),
    ("threshold_drift", (Place.WIDTH,), USE, 5.0, 60.0, 0),
    ("catch_like", (Place.STRENGTH,), (Driver.PULSES,), 0.05, 1.2, -1),
    ("asymmetric_relaxation", RATES, (Driver.RISE, Driver.FALL), 0.0, 1.0, 0),
    ("activation_dependent_speed", RATES, (Driver.DRIVE, Driver.TORQUE), 0.0, 1.0, 0),
    ("mixed_fibres", (Place.TORQUE,), (Driver.DRIVE,), 0.05, 1.2, 1),
    ("output_saturation", AFTER_LAGS, (Driver.SQUARE,), 0.0, 0.0, -1),
    ("recruitment_hysteresis", AFTER_LAGS, (Driver.WIDTH_PLAY,), 0.0, 0.0, 0),
)
"""Effects of the library that act as a term does: its places, drivers, lags from and to, s, and sign (0: either)."""
BOUNDED = {"change": "its size", "lag_s": "its lag", "reach": "its play"}
"""Parameters in words, where one lies at its bound: its interval then ends there, whatever the record says."""
LEVEL = np.linspace(0.0, 1.0, 41)
PERCENTILES = 2.5, 97.5
"""Those of draws between which 95 % lie."""


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
    values = LAGS_S if form.parameters[1].name == "lag_s" else REACHES
    return tuple(value for value in values if value <= form.parameters[1].upper)


def acting(place: Place, exponent: np.ndarray) -> np.ndarray:
    """Factor by which an exponent z changes its place; what it adds to the torque, as a share of the largest."""
    return exponent if place == Place.TORQUE else np.exp(LARGEST * np.tanh(exponent / LARGEST))


def behaves_as(place: Place, driver: Driver, size: np.ndarray, lag_s: float) -> tuple[str, ...]:
    """Ids of the library's effects that act as a term does; none where its sign is open. `size`: its draws."""
    sign = np.sign(np.percentile(size, PERCENTILES))
    return tuple(
        effect
        for effect, places, drivers, low_s, high_s, wanted in BEHAVIOURS
        if place in places and driver in drivers and low_s <= lag_s <= high_s
        if sign[0] == sign[1] and wanted in (0, sign[0])
    )


def _number(value: float, sign: str = "") -> str:
    """Two digits that count, never with an exponent."""
    value = float(f"{value:.1e}")  # first: 9.96 becomes 10, and not 10.0
    return f"{value:{sign}.{max(1 - math.floor(math.log10(abs(value) or 1.0)), 0)}f}"


def _stated(draws: np.ndarray, sign: str = "") -> tuple[str, str]:
    """The fitted value, that of the first draw, and the 95 % interval of the others."""
    low, high = np.percentile(draws[1:], PERCENTILES)
    return _number(float(draws[0, 0]), sign), f"{_number(low, sign)} to {_number(high, sign)}"


def _sized(place: Place, driver: Driver, exponent: np.ndarray) -> str:
    """How a term changes its place where its driver is 1: a change in percent, or a factor where it may double."""
    effect, whole = acting(place, exponent), DRIVERS[driver][2]
    if place != Place.TORQUE and np.percentile(effect[1:], PERCENTILES[1]) > 2.0:
        value, interval = _stated(effect)
        return f"× {value} {whole} ({interval})"
    value, interval = _stated(100.0 * (effect - (place != Place.TORQUE)), "+")
    return f"{value} %{' of the largest' if place == Place.TORQUE else ''} {whole} ({interval} %)"


def _equation(place: Place, driver: Driver, size: str, other: str) -> str:
    """Equation of a term; `size` and `other` (lag or reach): numbers or names."""
    acts, share = PLACES[place][1], DRIVERS[driver][1]
    if driver == Driver.SQUARE:
        return f"{acts}; z = {size}·{share}"
    state = f"x' = ({share} - x)/{other}" if later(driver) else f"x follows {share} behind a play of ±{other}"
    return f"{acts}; z = {size}·x, {state}{RATES_IN_WORDS.get(driver, '')}"


def _shape(form: Form, values: Mapping[str, np.ndarray]) -> Shape:
    place, driver = Place(int(form.law["place"])), Driver(int(form.law["driver"]))
    (size, other), (where, what) = (*values.values(), np.zeros((1, 1)))[:2], (PLACES[place][0], DRIVERS[driver][0])
    words, full, lag_s = f"{where.capitalize()} <- {what}", size, float(other[0, 0])
    if later(driver):
        value, interval = _stated(other)
        words += f", {value} s late ({interval} s)"
        at, along = 4.0 * lag_s * LEVEL, f"Time, {what} {_number(2.0 * lag_s)} s long, then none (s)"
        held = np.minimum(at, 2.0 * lag_s)
        lines, second = {"change": -np.expm1(-held / other) * np.exp((held - at) / other)}, f"{value} s"
    elif driver == Driver.SQUARE:
        at, lines, along, second = LEVEL, {"change": LEVEL**2}, "Torque (share of the largest)", ""
    else:
        second, interval = _stated(100.0 * other)
        words, full, second = f"{words} of ±{second} % ({interval} %)", size * (1.0 - other), _number(lag_s)
        lines = {"rising": np.maximum(LEVEL - other, 0.0), "falling": np.minimum(LEVEL + other, 1.0 - other)}
        at, along = LEVEL, f"{what.removesuffix(' with play').capitalize()} (share of the largest)"
    name = where.removeprefix("factor of the ")
    parameters = zip(form.parameters, values.values(), strict=True)
    ends = [BOUNDED[p.name] for p, drawn in parameters if np.isclose(drawn[0, 0], (p.lower, p.upper), rtol=1e-3).any()]
    at_bound = f" At the bound of what is tried: {' and '.join(ends)}." if ends else ""
    return Shape(
        place=where,
        driven_by=what,
        words=f"{words}: {_sized(place, driver, full)}.{at_bound}",
        driver=along,
        at=at,
        effect="Torque added (share of the largest)" if place == Place.TORQUE else f"{name.capitalize()} (factor)",
        lines={line: acting(place, size * x) for line, x in lines.items()},
        equation=_equation(place, driver, _number(float(size[0, 0])), second),
        behaves_as=behaves_as(place, driver, size[1:], lag_s if later(driver) else 0.0),
    )


def _term(place: Place, driver: Driver) -> Effect:
    where, what = PLACES[place][0], DRIVERS[driver][0]
    parameters = [Parameter("change", "1", -3.0, 3.0, about="exponent z at the full driver, held")]
    if later(driver):
        parameters.append(Parameter("lag_s", "s", 0.02, longest_s(place), 0.0, (0.25,), "log", about="time constant"))
    elif driver > Driver.SQUARE:
        parameters.append(Parameter("reach", "1", 0.01, 0.6, 0.0, (0.12,), "log", about="half of the play, a share"))
    equation = _equation(place, driver, "change", parameters[-1].name)
    return Effect(
        id=f"free_{place.name.lower()}_by_{driver.name.lower()}",
        name=f"{place.name} by {driver.name}".replace("_", " ").capitalize(),
        forms=(Form("term", "term", equation, tuple(parameters), law={"place": place, "driver": driver, "lag": 1.0}),),
        signature=f"The error follows the {what}, as if the {where} changed with it.",
        resembles=(),
        separated_by="Levels held for times about the lag, and rests as long.",
        plain=f"The {where} changes with the {what}: the picture shows by how much and how late. No effect of the "
        "library describes it.",
        source="a term of a first-order change; cf. play of Prandtl and Ishlinskii",
        shape=_shape,
    )


EFFECTS = tuple(_term(place, driver) for place in Place for driver in Driver if later(driver) or place >= Place.TORQUE)
