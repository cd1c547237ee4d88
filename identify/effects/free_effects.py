"""Free effects: they describe an error that no other effect explains, and name no cause."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stimrig.identify.dynamics.free_lags import LOW, FreeLaw
from stimrig.identify.effects.base import Effect, Form, Parameter, Scene, Shape, Values, adapt, form

LEVEL = np.linspace(0.0, 1.0, 41)
_FILL = Parameter("fill_s", "s", 0.5, 200.0, 0.0, (20.0, 4.0, 50.0), "log", about="time constant under full work")
_EMPTY = Parameter("empty_s", "s", 0.5, 400.0, 0.0, (40.0, 10.0, 40.0), "log", about="time constant at rest")
_DRIVERS: dict[str, tuple[str, dict[FreeLaw, str | float]]] = {
    "by_torque": ("torque", {}),
    "by_pulses": ("1 under pulses", {FreeLaw.BY_PULSES: 1.0}),
    "by_drive": ("f(u)", {FreeLaw.BY_DRIVE: 1.0}),
}
"""What fills the slow state: its name in the equation, and the column that says so."""
WORK_S = 20.0
"""Full work in the picture of a slow state, then rest."""
TIME_S = np.arange(0.0, 4.0 * WORK_S + 0.5, 0.5)
_AFTER_WORK = "time, full work for 20 s, then rest (s)"


def _course(values: Mapping[str, float]) -> np.ndarray:
    """The slow state at `TIME_S`, 0 to 1."""
    worked = -np.expm1(-np.minimum(TIME_S, WORK_S) / values["fill_s"])
    return worked * np.exp(-np.maximum(TIME_S - WORK_S, 0.0) / values["empty_s"])


def _percent(share: float) -> str:
    return f"{100.0 * share:+.0f} %"


def _seconds(value_s: float) -> str:
    return f"{value_s:.2g} s" if value_s < 100.0 else f"{value_s / 60.0:.2g} min"


# ---- a gate ----

GATE_S = np.linspace(0.0, 0.5, 101)
STOPS_S = 0.25
SLOWS = 0.3
"""Log of the change of speed above which the gate is described as one of speed, not of the drive: a third."""


def _gate_shape(_form: Form, values: Mapping[str, float]) -> Shape:
    def opened(time_s: np.ndarray) -> np.ndarray:
        lags = time_s / values["gate_s"]
        return 1.0 - (1.0 + lags) * np.exp(-lags)

    bound = opened(GATE_S) - opened(np.maximum(GATE_S - STOPS_S, 0.0))
    gate = (1.0 + values["bend"]) * bound / (1.0 + values["bend"] * bound)
    half_s = float(np.interp(0.5, gate[GATE_S <= STOPS_S], GATE_S[GATE_S <= STOPS_S]))
    stays_s = float(np.max(GATE_S[gate > 0.5], initial=STOPS_S)) - STOPS_S
    words = (
        f"Pulses open a gate, half of it within {1000.0 * half_s:.0f} ms, and it stays half open for "
        f"{1000.0 * stays_s:.0f} ms after the last one; open, the muscle has {np.exp(values['gate_rate']):.2g} times "
        "the speed that it has closed."
    )
    enters = "rate of fall" if abs(values["gate_rate"]) > SLOWS else "drive"
    lines = {"opening": gate, "speed": np.exp(values["gate_rate"] * gate)}
    axis = "time, pulses for 0.25 s, then none (s)"
    return Shape(enters, "time since", words, axis, GATE_S, "opening and speed", lines)


_GATE = Effect(
    id="free_gate",
    name="A gate that pulses open",
    forms=(
        Form(
            "two_lags",
            "lags",
            "w = γ f(u of the last pulse); γ = (1 + bend) c/(1 + bend·c); c follows the presence of pulses by two lags "
            "of gate_s; both rates · exp(gate_rate·γ)",
            (
                Parameter("gate_s", "s", 0.004, 0.12, 0.0, (0.02, 0.04), "log", about="time constant of either lag"),
                Parameter("bend", "1", -0.8, 12.0, 0.0, (1.0, 3.0), about="saturation"),
                Parameter("gate_rate", "1", -2.5, 2.5, 0.0, (-0.5,), about="log speed of the open muscle"),
            ),
            law={FreeLaw.GATE_S: "gate_s", FreeLaw.BEND: "bend", FreeLaw.GATE_RATE: "gate_rate"},
        ),
    ),
    signature="The start and the end of a train differ from changes of width within it.",
    resembles=("catch_like", "asymmetric_relaxation", "free_speed"),
    separated_by="Jumps of width within a train, beside trains that begin and end.",
    plain="That pulses come, and how wide they are, act in different ways: the picture shows how the first ones open "
    "the muscle. No effect of the library describes it.",
    source="cf. calcium and its binding in Ding et al. 2003",
    main={"gate_s": "time to open"},
    shape=_gate_shape,
)


# ---- the torque itself ----


def _bent(level: np.ndarray, p: Values) -> np.ndarray:
    """Torque added to a level; 0 at zero and at full torque."""
    return level * (1.0 - level) * (p["bend"] + p["skew"] * (1.0 - 2.0 * level))


@form(
    "output",
    "y + y_max·l (1 - l)(bend + skew (1 - 2 l)), l = y/y_max",
    Parameter("bend", "1", -1.5, 1.5, 0.0, (0.1,), about="twice the change at half of the torque, as its share"),
    Parameter("skew", "1", -1.5, 1.5, 0.0, (0.0,), about="the same, more at low levels than at high ones"),
)
def after(torque: np.ndarray, p: Values, scene: Scene) -> np.ndarray:
    return torque + scene.scale_nm * _bent(np.clip(torque / scene.scale_nm, 0.0, 1.3), p)


def _level_shape(effect_form: Form, values: Mapping[str, float]) -> Shape:
    if effect_form.name == "before":
        place, drive = ("drive", "drive, at rest: 1"), 1.0 + values["feedback"] * LEVEL
        words = f"At full torque the drive by the same pulse has changed by {_percent(values['feedback'])}."
        lines = {"drive": drive}
    else:
        place, torque = ("output", "torque that arrives (share)"), LEVEL + _bent(LEVEL, dict(values))
        change = _percent(torque[20] / 0.5 - 1.0)
        words, lines = f"Half of the torque arrives changed by {change}, behind the dynamics.", {"torque": torque}
    return Shape(place[0], "torque", words, "torque (share of the largest)", LEVEL, place[1], lines)


_LEVEL = Effect(
    id="free_level",
    name="Torque that acts on itself",
    forms=(
        after,
        Form(
            "before",
            "lags",
            "w = (1 + feedback·y/y_max) f(u)",
            (Parameter("feedback", "1", -1.0, 1.0, 0.0, (0.05,), about="change of the drive at full torque, a share"),),
            law={FreeLaw.FEEDBACK: "feedback"},
        ),
    ),
    signature="Rise and fall bend differently at low and at high torque.",
    resembles=("output_saturation", "free_speed"),
    separated_by="Steps between several levels.",
    plain="How much torque there is changes what the same pulse adds: the picture shows how. No effect of the library "
    "describes it.",
    source="cf. electrodes that move with the muscle, springs that stiffen",
    main={"bend": "bend", "feedback": "change of the drive"},
    shape=_level_shape,
)


# ---- the speed of both lags ----

_RATES = {
    "direction": "log of the rate while rising over that while falling",
    "rising": "power of the level in the rate while rising",
    "falling": "power of the level in the rate while falling",
}
_SPEEDS = {f"{lag}_{what}": about for lag in ("first", "second") for what, about in _RATES.items()}
_SPEEDS["coupling"] = "how much the second lag's distance drives the first"


def _speed_shape(_form: Form, values: Mapping[str, float]) -> Shape:
    lines, power = {}, np.log((LEVEL + LOW) / (1.0 + LOW))
    for way, sign in (("rising", 0.5), ("falling", -0.5)):
        logs = [sign * values[f"{lag}_direction"] + values[f"{lag}_{way}"] * power for lag in ("first", "second")]
        lines[way] = np.exp(np.mean(logs, 0))
    swing = {way: float(np.ptp(np.log(line)) + abs(np.mean(np.log(line)))) for way, line in lines.items()}
    influence = [sum(abs(values[f"{lag}_{what}"]) for what in _RATES) for lag in ("first", "second")]
    middle, low = LEVEL.size // 2, LEVEL.size // 4
    ratio = lines["rising"][middle] / lines["falling"][middle]
    rise, fall = (line[-1] / line[low] for line in lines.values())
    words = (
        f"At half of the torque the speed while it rises is {ratio:.2g} times that while it falls; "
        f"from a quarter of the torque to the full one, that of the rise grows {rise:.2g}-fold and that of the fall "
        f"{fall:.2g}-fold."
    )
    enters = "rate of rise" if swing["rising"] >= swing["falling"] else "rate of fall"
    driven = "activation" if influence[0] >= influence[1] else "torque"
    return Shape(enters, driven, words, "torque (share of the largest)", LEVEL, "speed, of the plain model: 1", lines)


_SPEED = Effect(
    id="free_speed",
    name="Speed that depends on level and direction",
    forms=tuple(
        Form(
            name,
            "lags",
            "a' = k1 (w - a + κ(a - y)), y' = k2 (a - y); ln k = ln k0 ± direction/2 + power·ln((level + 1/4)/(5/4)), "
            f"each power for rise and fall; {words}",
            tuple(Parameter(name, "1", -1.5, 1.5, 0.0, (0.0,), about=about) for name, about in _SPEEDS.items()),
            law={FreeLaw[name.upper()]: name for name in _SPEEDS} | order,
        )
        for name, words, order in (
            ("quick_first", "the quicker lag first", {}),
            ("slow_first", "the slower lag first", {FreeLaw.SWAPPED: 1.0}),
        )
    ),
    signature="Rise and fall, or low and high levels, differ in speed, and no one ratio describes it.",
    resembles=("asymmetric_relaxation", "activation_dependent_speed", "free_gate", "free_level"),
    separated_by="Steps up and down between several levels.",
    plain="How quickly the torque follows depends on the level and on the direction: the picture shows how. No effect "
    "of the library describes it.",
    source="two lags with free rates; cf. Winters 1995, Zajac 1989",
    main={"first_direction": "speed of rise over that of fall"},
    shape=_speed_shape,
)


# ---- a slow state: strength and speed, or a torque that it leaves ----


def _slow_forms(equation: str, drivers: tuple[str, ...], *parameters: Parameter) -> tuple[Form, ...]:
    law: dict[FreeLaw, str | float] = {FreeLaw.FILL_S: "fill_s", FreeLaw.EMPTY_S: "empty_s"}
    law |= {FreeLaw[p.name.upper()]: p.name for p in parameters}
    return tuple(
        Form(
            name,
            "lags",
            f"{equation}; s' = a (1 - s)/fill - (1 - a) s/empty; a: {_DRIVERS[name][0]}",
            (_FILL, _EMPTY, *parameters),
            law=law | _DRIVERS[name][1],
        )
        for name in drivers
    )


def _strength_shape(_form: Form, values: Mapping[str, float]) -> Shape:
    state = _course(values)
    strength, speed = 1.0 + values["gain"] * state, np.exp(values["rate"] * state)
    top = int(np.argmax(state))
    slowed = abs(values["rate"]) > abs(np.log(max(1.0 + values["gain"], 0.05)))
    words = (
        f"After 20 s of full work the strength has changed by {_percent(strength[top] - 1.0)} and the speed by "
        f"{_percent(speed[top] - 1.0)}; at rest this goes away with a time constant of {_seconds(values['empty_s'])}."
    )
    lines = {"strength": strength, "speed": speed}
    enters = "rate of fall" if slowed else "drive"
    return Shape(enters, "sum of the past", words, _AFTER_WORK, TIME_S, "strength and speed, rested: 1", lines)


_STRENGTH = Effect(
    id="free_strength",
    name="Strength and speed that change with use",
    forms=_slow_forms(
        "w = (1 + gain·s) f(u), both rates · exp(rate·s)",
        ("by_torque", "by_pulses", "by_drive"),
        Parameter("gain", "1", -0.95, 1.5, 0.0, (-0.1,), about="change of strength after long work, as a share"),
        Parameter("rate", "1", -1.5, 1.5, 0.0, (-0.1,), about="log of the change of speed after long work"),
    ),
    signature="Early and late answers to the same pulses differ in size, and in speed.",
    resembles=("free_ways", "free_zero"),
    separated_by="The same steps before and after long work, and once more after a rest.",
    plain="The muscle answers otherwise after it has worked: the picture shows by how much, and how soon it recovers. "
    "No effect of the library describes it.",
    source="a slow state with gain and rate, free in sign; cf. Ding et al. 2003",
    main={"gain": "gain"},
    shape=_strength_shape,
)


def _zero_shape(_form: Form, values: Mapping[str, float]) -> Shape:
    added = values["zero"] * _course(values)
    words = (
        f"20 s of full work add {_percent(float(added[np.argmax(np.abs(added))]))} of the largest torque, which goes "
        f"away at rest with a time constant of {_seconds(values['empty_s'])}."
    )
    axes = _AFTER_WORK, TIME_S, "torque added (share of the largest)"
    return Shape("zero", "sum of the past", words, *axes, {"torque added": added})


_ZERO = Effect(
    id="free_zero",
    name="Torque that outlasts the stimulation",
    forms=_slow_forms(
        "y + zero·y_max·s",
        ("by_torque", "by_pulses"),
        Parameter("zero", "1", -0.5, 0.5, 0.0, (0.02,), about="torque added after long work"),
    ),
    signature="The torque at rest, or the level reached, depends on the work before.",
    resembles=("baseline_drift", "mixed_fibres", "free_strength", "free_ways"),
    separated_by="A long train, then a long rest.",
    plain="Work leaves a torque behind, which goes away slowly: the picture shows how much and how long. No effect of "
    "the library describes it.",
    source="cf. plateau potentials, creep of a fixture",
    main={"zero": "torque left by work"},
    shape=_zero_shape,
)


# ---- two ways ----

SHARES = {f"share_{round(100 * level)}": level for level in (0.0, 0.25, 0.5, 0.75, 1.0)}


def _share(level: np.ndarray, p: Values) -> np.ndarray:
    """The slow way's share, linear between the levels of `SHARES`; `p` as `apply` takes it."""
    place = level * (len(SHARES) - 1)
    first = np.minimum(place.astype(np.int64), len(SHARES) - 2)
    known = np.concatenate([np.reshape(p[name], (-1, 1)) for name in SHARES], axis=1)
    row = np.arange(len(known))[:, None]
    return known[row, first] + (place - first) * (known[row, first + 1] - known[row, first])


@form(
    "branch",
    "y = G(T) (1 - s) f (1 - loss_quick·x1) + G(ratio·T) s f (1 - loss_slow·x2); s linear between five levels of f; "
    "x' = a (1 - x)/fill - (1 - a) x/empty, a: the way's own drive",
    *(
        Parameter(
            name, "1", 0.0, 1.0, 0.0, (0.3, 0.6), about=f"share of the slow way at {100 * level:.0f} % of the level"
        )
        for name, level in SHARES.items()
    ),
    Parameter("ratio", "1", 1.2, 12.0, 1.0, (2.0, 4.0), "log", about="slow time constant over the quick one"),
    Parameter("loss_quick", "1", -0.9, 0.95, 0.0, (0.1,), about="share that the quick way loses with use"),
    Parameter("loss_slow", "1", -0.9, 0.95, 0.0, (0.0,), about="share that the slow way loses with use"),
    Parameter("fill_s", "s", 1.0, 100.0, 0.0, (5.0,), "log", about="time constant under full work"),
    Parameter("empty_s", "s", 2.0, 200.0, 0.0, (20.0,), "log", about="time constant at rest"),
)
def parallel(drive: np.ndarray, p: Values, scene: Scene) -> list:
    share = _share(np.clip(np.abs(drive) / scene.scale_nm, 0.0, 1.0), p)
    fill_s, empty_s = p["fill_s"][:, 0], p["empty_s"][:, 0]

    def used(way: np.ndarray, loss: np.ndarray) -> np.ndarray:
        if not np.any(loss):
            return way
        work = np.minimum(np.abs(way) / scene.scale_nm, 1.0)
        return way * (1.0 - loss * adapt(work, fill_s, empty_s, False, scene.step_s, scene.rest_s)[0])

    quick, slow = used((1.0 - share) * drive, p["loss_quick"]), used(share * drive, p["loss_slow"])
    return [(quick, np.ones_like(p["ratio"])), (slow, p["ratio"])]


def _ways_shape(_form: Form, values: Mapping[str, float]) -> Shape:
    share = _share(LEVEL[None, :], dict(values))[0]
    tires = max(abs(values["loss_quick"]), abs(values["loss_slow"])) > 0.2
    words = (
        f"A way that is {values['ratio']:.2g} times slower carries {100.0 * share[20]:.0f} % at half of the torque; "
        f"full use changes the quick way by {_percent(-values['loss_quick'])} and the slow one by "
        f"{_percent(-values['loss_slow'])}, with a time constant of {_seconds(values['fill_s'])}."
    )
    lines = {"slow way": share, "quick way": 1.0 - share}
    where = ("drive", "sum of the past") if tires else ("rate of fall", "width")
    return Shape(*where, words, "level of recruitment (share of the largest)", LEVEL, "share of the torque", lines)


_WAYS = Effect(
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
    shape=_ways_shape,
)

EFFECTS = (_GATE, _LEVEL, _SPEED, _STRENGTH, _WAYS, _ZERO)
