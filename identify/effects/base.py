"""What an effect is: forms with their parameters and laws, and its words; `Effect` and `Form` are the entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.polynomial.chebyshev import chebvander

IDLE_SHARE = 0.1
"""Pulses of this share of the largest width are as good as none: some stimulators never send 0."""
STAGES = ("pulse_width", "gain", "speed", "term", "branch", "delay", "filter", "output", "additive", "sensor")
"""The stages at which a form can act, in the order in which the signal passes them: see `Form`."""

JOINT_COLUMNS = frozenset({"angle_rad", "velocity_rad_s"})
"""Columns that an effect may need beside pulses and torque."""
LEAST_RANGE_RAD = 0.1
"""A smaller range of angles counts as this one: of a joint that is held, noise is no shape."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a form."""

    name: str  # ends in its unit, if it has one
    unit: str  # such as µs, s, N·m; "1" for a pure number
    lower: float  # bound
    upper: float
    """Bounds. They set the width of the prior, and so the evidence: choose them as physiology allows, not wider."""
    neutral: float = 0.0
    """Value at which the form changes nothing, alone or together with other parameters; may be outside the bounds."""
    start: tuple[float, ...] = (0.0,)
    """Starting values, one for each run of the fit. The parameter with most values sets the number of runs."""
    scale: str = "linear"
    """The scale on which it is varied and on which its prior is symmetric: "linear" or "log"."""
    relative: str = ""
    """Unit of bounds, start and neutral: "torque", "width", "span" are the record's largest torque, largest pulse width
    and length; "level" is the largest torque, counted from the sensor's zero."""
    about: str = ""  # one line for people

    def on(self, scene: Scene) -> Parameter:
        """The parameter with its bounds in absolute units."""
        if not self.relative:
            return self
        unit = {"width": scene.largest_us, "span": scene.span_s}.get(self.relative, scene.scale_nm)
        zero = scene.zero_nm if self.relative == "level" else 0.0
        return replace(
            self,
            lower=zero + self.lower * unit,
            upper=zero + self.upper * unit,
            neutral=zero + self.neutral * unit,
            start=tuple(zero + value * unit for value in self.start),
            relative="",
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the library."""
        return {
            "name": self.name,
            "unit": self.unit,
            "range": [self.lower, self.upper],
            "relative_to": self.relative or None,
            "neutral": self.neutral if np.isfinite(self.neutral) else None,
            "start": list(self.start),
            "about": self.about,
        }


@dataclass(frozen=True)
class Scene:
    """Data of the record that a form can use, at the times at which it is evaluated."""

    time_s: np.ndarray  # shape (K,); times since the record's start, s
    pulse_width_us: np.ndarray  # shape (K,); pulse width applied, µs
    step_s: float  # pulse interval, s
    scale_nm: float  # the record's largest torque, N·m; a constant, not a parameter
    largest_us: float  # largest pulse width, µs
    angle_rad: np.ndarray | None = None  # of the joint, shape (K,)
    velocity_rad_s: np.ndarray | None = None
    """Shape (K,); joint angle, rad, and velocity, rad/s, if the record has them."""
    acceleration_rad_s2: np.ndarray | None = None  # shape (K,); angular acceleration, rad/s², from the velocity
    reference_rad: float | None = None
    """The model's own angle: here the curve holds as it stands, and no passive torque is counted. None: the angle at
    the record's start."""
    angle_range_rad: tuple[float, float] | None = None
    """Smallest and largest angle that the model was fitted on, rad. None: those of the record."""
    begins: np.ndarray | None = None  # shape (K,); where a recording begins; None: at the first time alone
    noise_sd_nm: float = 0.0  # white noise of a sample, N·m
    zero_nm: float = 0.0
    """Zero of the record's torque, N·m. Only the sensor stage sees it; at other stages torque is relative to it."""
    reference_s: float = 0.0
    """Time at which a drifting recruitment curve holds, s: the mean time of the partly recruited pulses."""
    fitted: np.ndarray | None = None  # shape (K,); where the torque is used for fitting
    pauses_s: np.ndarray | None = None
    """Shape (K,); for the first interval of each part: the part of the pause before it that `time_s` does not contain,
    s."""
    states: Mapping[str, float] = field(default_factory=dict)
    """By effect id, where the slow state of an effect begins (`Form.state`), 0 to 1; 0 where there is none."""
    within: Scene | None = None
    """The same at several places of each interval, (n K,), for what turns round within one; None: no intervals."""

    @property
    def rest_s(self) -> np.ndarray:
        """Rest before each interval that `time_s` does not contain, s, shape (K,)."""
        return np.zeros(self.time_s.size) if self.pauses_s is None else self.pauses_s

    @property
    def on(self) -> np.ndarray:
        """1.0 where a pulse has a width, else 0.0, shape (K,)."""
        return (self.pulse_width_us > 0).astype(float)

    @property
    def acting(self) -> np.ndarray:
        """The same where its width is more than an idling stimulator's."""
        return (self.pulse_width_us > IDLE_SHARE * self.largest_us).astype(float)

    @property
    def span_s(self) -> float:
        """Length of the record, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @cached_property
    def share_of_span(self) -> np.ndarray:
        """Place of each time in the record, from 0 to 1, shape (K,)."""
        return np.clip((self.time_s - self.time_s[0]) / max(self.span_s, 1e-9), 0.0, 1.0)

    @property
    def angle(self) -> np.ndarray:
        """Angle of the joint, rad, shape (K,); only for a record that has it."""
        assert self.angle_rad is not None
        return self.angle_rad

    @property
    def speed(self) -> np.ndarray:
        """Velocity of the joint, rad/s, shape (K,); 0 without one."""
        return np.zeros_like(self.time_s) if self.velocity_rad_s is None else self.velocity_rad_s

    @cached_property
    def away_rad(self) -> np.ndarray:
        """Angle from the reference angle, rad, shape (K,)."""
        return self.angle - (self.angle[0] if self.reference_rad is None else self.reference_rad)

    @cached_property
    def place(self) -> np.ndarray:
        """Place in the range of fitted angles, from -1 to 1 at its ends and held there beyond them, shape (K,)."""
        return self._placed(self.angle)

    def _placed(self, angle_rad: np.ndarray | float) -> np.ndarray:
        low, high = self.angle_range_rad or (float(self.angle.min()), float(self.angle.max()))
        return np.clip((2.0 * angle_rad - low - high) / max(high - low, LEAST_RANGE_RAD), -1.0, 1.0)

    def bends(self, degrees: int) -> np.ndarray:
        """Chebyshev polynomials of `place`, of degrees 1 to `degrees`, all 0 at the reference angle, shape (n, K)."""
        home = self._placed(float(self.angle[0] - self.away_rad[0]))
        return (chebvander(self.place, degrees) - chebvander(np.array([home]), degrees)).T[1:]


Values = dict[str, Any]
"""Parameters by name, each of shape (M, 1), or a number where a form is called row by row."""
Apply = Callable[[Any, Values, Scene], Any]


@dataclass(frozen=True)
class Form:
    """One published form of an effect.

    `apply(x, p, scene)` depends on the stage. x and the result have shape (K,); p holds the parameters by name. At the
    neutral values it must return x itself, bit for bit.

    - "pulse_width": x is the pulse width, µs; returns the pulse width that acts.
    - "gain": x is the drive f(u), N·m; returns the drive.
    - "speed", "term": no `apply`; `law` says what sets the time constant, or what the term changes and what drives it.
    - "branch": x is the drive; returns a list of (drive, factor on the time constant), whose responses are added.
    - "delay": x is None; returns a delay, s.
    - "filter": x is (torque, rate) at the ends of the pulse intervals, shape (K + 1,); returns the same.
    - "output": x is the torque; returns the torque. Each time by itself.
    - "additive": x is None; returns a torque that is added at `scene.time_s`.
    - "sensor": x is the torque, after all other stages; returns the measured torque.
    """

    name: str  # short id of the form
    stage: str  # one of `STAGES`
    equation: str  # the equation, for people
    parameters: tuple[Parameter, ...]
    """The parameters; their first starting values form the first run, their second ones the second, and so on."""
    apply: Apply | None = None  # the law, as above; None for the stages that `law` describes
    batched: bool = False
    """True if `apply` takes x of shape (M, K) and parameters of shape (M, 1). If not, it is called row by row."""
    law: dict[Any, Any] = field(default_factory=dict)
    """What sets each column of the compiled table: a parameter, or a number. Columns are (`Lag`, `SpeedLaw`) for
    "speed", set by the logarithm of what is varied on that scale; `place`, `driver` and `lag` for "term"."""
    propose: Callable[[np.ndarray, Scene, dict[str, float]], list[dict[str, float]]] | None = None
    """`propose(residual_nm, scene, previous)` returns starting values found in the data, as a list of dicts; empty if
    there are none. `previous` holds the parameters of the form before it in a chain."""
    grows: bool = False
    """True if the form is the next in a chain. It is tried only while the forms before it gain."""
    fixed: bool = False
    """True if its parameters are estimated from the samples before the fit, and the torque is corrected for it then."""
    scales: bool = False
    """For "output" only: whether it multiplies the torque by what does not depend on it; x may then be 1."""
    source: str = ""  # publication
    state: Callable[[np.ndarray, dict[str, Any], Scene], np.ndarray] | None = None
    """For "gain" only, and for a form with a slow state between 0 (rested) and 1 that begins at `scene.states`:
    `state(x, p, scene)`, called as a batched `apply` is, returns it after the last interval, shape (M,)."""

    def starts(self, scene: Scene) -> list[dict[str, float]]:
        """Starting values, one dict per run.

        A form may add others, also with `base.time_constant_s` and `base.damping`: values of the linear dynamics, by
        which the model without the effect may have imitated it.
        """
        on = [p.on(scene) for p in self.parameters]
        runs = max((len(p.start) for p in on), default=1)
        return [{p.name: p.start[min(i, len(p.start) - 1)] for p in on} for i in range(runs)]

    def accepts(self, parameters: dict[str, float], scene: Scene) -> bool:  # noqa: ARG002
        """Return True if the result of a fit is plausible."""
        return True

    def call(self, x: Any, p: dict[str, np.ndarray], scene: Scene) -> Any:
        """`apply` for M rows of parameters: x of shape (M, K), a tuple of such arrays, or None; p of shape (M, 1)."""
        assert self.apply is not None
        if self.batched:
            return self.apply(x, p, scene)
        results = []
        for m in range(next(iter(p.values())).shape[0]):
            row = None if x is None else tuple(part[m] for part in x) if isinstance(x, tuple) else x[m]
            results.append(self.apply(row, {name: float(value[m, 0]) for name, value in p.items()}, scene))
        if isinstance(results[0], tuple):
            return tuple(np.stack(parts) for parts in zip(*results, strict=True))
        return np.stack([np.broadcast_to(np.asarray(result, float), scene.time_s.shape) for result in results])


@dataclass(frozen=True)
class Shape:
    """Fitted behaviour of a free effect, as a sentence and curves."""

    place: str  # where it enters
    driven_by: str  # by what
    words: str  # the same in one sentence with its size
    driver: str  # name and unit of the horizontal axis
    at: np.ndarray  # shape (n,); places there
    effect: str  # name and unit of the vertical axis
    lines: Mapping[str, np.ndarray]  # shape (M, n); the curves of all draws, by name
    equation: str  # with its numbers
    behaves_as: tuple[str, ...]  # ids of the library's effects that act like it


@dataclass(frozen=True)
class Effect:
    """One physical effect, in one or more forms."""

    id: str  # such as "fatigue"; used in files, commands and the REST API
    name: str  # name for people
    forms: tuple[Form, ...]
    """The published variants. The fit takes the most likely one."""
    signature: str  # what it looks like in the residual of a model without it
    resembles: tuple[str, ...]  # ids of effects that a record often cannot separate from it
    separated_by: str  # the test that separates them
    plain: str  # a paragraph for clinicians
    source: str = ""  # where the physics is described
    needs: tuple[str, ...] = ()  # columns that the record must have; otherwise the effect is not tried
    predictable: bool = True
    """True if it can be predicted on another record because it follows from the pulses. Hum, a moving zero, efforts and
    tremor cannot: their mean over the fitted rows stays as a zero, their size widens the band."""
    sporadic: bool = False
    """True if it comes and goes by no law, as efforts and tremor do. It can repair any error, so more evidence is
    required for it; its mean does not stay either."""
    band: bool = False
    """True if it is a narrow band of noise: detected in the residual's spectrum, part of the noise beside other
    effects."""
    detect: Callable[[Any], tuple[str, dict[str, float]] | None] | None = None
    """For an effect that is sought in the samples, before any fit: `detect(raw)` returns the form and its parameters if
    they show it beyond doubt, else None. `raw` is what `stimrig.identify.estimation.samples.inspect` gives."""
    prior: float = 0.0  # logarithm of its prior odds, relative to other effects
    muscle: bool = True
    """True if it is a property of the muscle. Otherwise it belongs to one record, its sensor or the person's mood:
    differences of its parameters between sessions say nothing about the muscle."""
    main: dict[str, str] = field(default_factory=dict)
    """The parameters that stand for it in the trend, first choice first, and their names for people, without units; the
    form's first one where none of them is its own. The service reads this, `muscle` and `name` without an import."""
    shape: Callable[[Form, Mapping[str, np.ndarray]], Shape] | None = None
    """For a free effect only: `shape(form, values)` returns curves and words; values, shape (M, 1), are fitted, then
    draws. It describes an error that no other effect explains, is tried last, and its name claims no physics."""

    @property
    def stage(self) -> str:
        """The stage of its first form."""
        return self.forms[0].stage

    @property
    def moves_with_joint(self) -> bool:
        """True if it depends on the angle or the velocity of the joint."""
        return not JOINT_COLUMNS.isdisjoint(self.needs)

    @property
    def part(self) -> str:
        """Where it stands in the paper's Fig. 2: "f", "G", "g" or "h"; "" where that has no place for it."""
        if self.moves_with_joint:
            return "h" if self.stage == "additive" else "g"
        return {"pulse_width": "f", "gain": "f", "additive": "", "sensor": "", "output": ""}.get(self.stage, "G")

    def form(self, name: str) -> Form:
        """A form by its name; the first form if the name is empty."""
        for form in self.forms:
            if form.name == name or not name:
                return form
        raise KeyError(name)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the library, without forms of a great many parameters."""
        forms = [
            {name: getattr(form, name) for name in ("name", "stage", "equation")}
            | {"parameters": [p.to_dict() for p in form.parameters], "source": form.source or self.source}
            for form in self.forms
            if form is self.forms[0] or len(form.parameters) < 40
        ]
        return {
            "id": self.id,
            "name": self.name,
            "stage": self.stage,
            "part": self.part,
            "equation": forms[0]["equation"],
            "parameters": forms[0]["parameters"],
            "forms": forms,
            "source": self.source,
            "signature": self.signature,
            "confused_with": list(self.resembles),
            "separated_by": self.separated_by,
            "plain": self.plain,
            "needs": list(self.needs),
            "predictable": self.predictable,
            "free": self.shape is not None,
        }


def form(
    stage: str, equation: str, *parameters: Parameter, name: str = "", kind: type[Form] = Form, **more: Any
) -> Callable[[Apply], Form]:
    """Decorator that makes a form of a function of all rows at once (`batched`); its name is the function's.

    Parameters
    ----------
    stage : str
        As `Form.stage`.
    equation : str
        For people.
    parameters : tuple of Parameter
        Of the law.
    name : str, optional
        In place of the function's.
    kind : type, optional
        A subclass of `Form` with starts of its own.
    **more
        Other fields of `Form`.
    """
    return lambda apply: kind(name or apply.__name__, stage, equation, parameters, apply, batched=True, **more)


Columns = dict[str, np.ndarray]
"""By parameter, what it multiplies: (K,), or (M, K) where that depends on other parameters."""


def basis(equation: str, *parameters: Parameter, **more: Any) -> Callable[[Callable[[Values, Scene], Columns]], Form]:
    """Decorator for a torque that is linear in some of its parameters: the function returns their columns."""
    return lambda columns: Form(
        columns.__name__,
        "additive",
        equation,
        parameters,
        lambda _, p, scene: weighted(p, columns(p, scene)),
        batched=True,
        **more,
    )


def weighted(p: Values, columns: Columns) -> np.ndarray:
    """Sum of columns by the parameters that weigh them, shape (M, K)."""
    common = [name for name, column in columns.items() if column.ndim == 1]
    total = sum((p[name] * column for name, column in columns.items() if column.ndim > 1), np.zeros(1))
    if not common:
        return total
    return total + np.concatenate([p[name] for name in common], axis=1) @ np.stack([columns[name] for name in common])


def slow_gain(
    effect: str,
    parameters: tuple[Parameter, ...],
    factor: Callable[[Values, np.ndarray], np.ndarray],
    name: str,
    equation: str,
    *,
    by_pulses: bool = False,
    constant: bool = False,
    source: str = "",
) -> Form:
    """A gain with a slow state (`adapt`) that fills with torque, or by pulses of any width; `factor(p, x)` is the gain.

    Its second parameter is the time constant of filling, its third that of recovery, `recovery_s`.
    """

    def used(drive: np.ndarray, p: Values, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        level = np.minimum(np.abs(drive) / scene.scale_nm, 1.0)
        a = np.tile(scene.on, (len(drive), 1)) if by_pulses else level
        onset_s, recovery_s, begin = p[parameters[1].name][:, 0], p["recovery_s"][:, 0], scene.states.get(effect, 0.0)
        return adapt(a, onset_s, recovery_s, constant, scene.step_s, scene.rest_s, begin)

    return Form(
        name,
        "gain",
        equation,
        parameters,
        lambda drive, p, scene: drive * factor(p, used(drive, p, scene)[0]),
        batched=True,
        source=source,
        state=lambda drive, p, scene: used(drive, p, scene)[1],
    )


@njit(cache=True, nogil=True)
def _filled(state, up, down, step_s):  # pragma: no cover
    """A slow state after a step: s' = up (1 - s) - down s, exact for held rates, 1/s; as it was where both are 0."""
    rate = up + down
    if not rate > 0.0:
        return state
    goal = up / rate
    return goal + (state - goal) * np.exp(-rate * step_s)


@njit(cache=True, nogil=True)
def adapt(drive, onset_s, recovery_s, constant, step_s, rest_s, begin):  # pragma: no cover
    """State x in [0, 1] with x' = a (1 - x)/onset - (1 - a) x/recovery; exact for a held drive a.

    With `constant`, recovery also continues under stimulation: x' = a (1 - x)/onset - x/recovery.

    `drive` is a in [0, 1], shape (M, K), both times have shape (M,); `rest_s`, shape (K,), is additional rest before
    each interval, `begin` x before the first. Returns the mean of x at the start and the end of each interval, shape
    (M, K), and x after the last.
    """
    rows, size = drive.shape
    out, last = np.empty((rows, size)), np.empty(rows)
    for m in range(rows):
        x = begin
        for k in range(size):
            if rest_s[k] > 0.0:
                x *= np.exp(-rest_s[k] / recovery_s[m])
            a = min(max(drive[m, k], 0.0), 1.0)
            up = a / onset_s[m]
            down = 1.0 / recovery_s[m] if constant else (1.0 - a) / recovery_s[m]
            end = _filled(x, up, down, step_s)
            out[m, k] = 0.5 * (x + end)
            x = end
        last[m] = x
    return out, last


def replaced_by(present: Sequence[tuple[str, Form]], forms: Iterable[Form]) -> str | None:
    """The effect of a model that cannot stand beside these forms: terms set the lags, so do speed laws and branches."""
    against = {"term": ("speed", "branch"), "speed": ("term",), "branch": ("term",)}
    stages = {stage for form in forms for stage in against.get(form.stage, ())}
    return next((name for name, form in present if form.stage in stages), None)
