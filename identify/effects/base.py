"""What an effect is: one or more published forms, each a pure array function with its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

STAGES = ("pulse_width", "gain", "speed", "branch", "delay", "filter", "output", "additive", "sensor")
"""Where a form enters, in the order in which the signal passes: see `Form`."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a form.

    Parameters
    ----------
    name : str
        Ends in its unit where it has one.
    unit : str
        SI or the field's (µs, s, N·m, 1).
    lower, upper : float
        Bounds; they're part of the test, so keep them honest.
    neutral : float
        Value at which the form changes nothing, alone or with another of the same form; may lie outside the bounds.
    start : tuple of float
        Values from which the fit starts, one run each (the longest of a form's parameters sets the number of runs).
    scale : str
        "linear" or "log": how the parameter is varied, and on which scale the prior is flat-ish.
    relative : str
        "torque", "width" or "span": bounds, start and neutral are in units of the record's largest torque, its largest
        pulse width or its length; "level": of its largest torque, above its zero, as the sensor counts.
    about : str
        One line for the page.
    """

    name: str
    unit: str
    lower: float
    upper: float
    neutral: float = 0.0
    start: tuple[float, ...] = (0.0,)
    scale: str = "linear"
    relative: str = ""
    about: str = ""

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


@dataclass(frozen=True)
class Scene:
    """What a form may know of the record, at the times at which it is asked.

    Parameters
    ----------
    time_s : ndarray, shape (K,)
        Times since the record's start, s.
    pulse_width_us : ndarray, shape (K,)
        Pulse width applied, µs.
    step_s : float
        Pulse interval, s.
    scale_nm : float
        The record's largest torque, N·m: a fixed number, not a parameter.
    largest_us : float
        Largest pulse width, µs.
    angle_rad, velocity_rad_s : ndarray or None, shape (K,)
        Joint angle and velocity, where the record has them.
    noise_sd_nm : float
        White noise of a sample, N·m.
    zero_nm : float
        Zero of the record's torque, N·m: the sensor counts from it, everything else above it.
    reference_s : float
        Time to which the recruitment curve belongs where it drifts: the middle of the partly recruited pulses.
    fitted : ndarray of bool or None, shape (K,)
        Where the torque is used for fitting.
    pauses_s : ndarray or None, shape (K,)
        What of a pause between two parts of a record is not in `time_s`, s, at the part's first interval.
    """

    time_s: np.ndarray
    pulse_width_us: np.ndarray
    step_s: float
    scale_nm: float
    largest_us: float
    angle_rad: np.ndarray | None = None
    velocity_rad_s: np.ndarray | None = None
    noise_sd_nm: float = 0.0
    zero_nm: float = 0.0
    reference_s: float = 0.0
    fitted: np.ndarray | None = None
    pauses_s: np.ndarray | None = None

    @property
    def rest_s(self) -> np.ndarray:
        """Rest before each interval that the intervals do not show, s, shape (K,)."""
        return np.zeros(self.time_s.size) if self.pauses_s is None else self.pauses_s

    @property
    def on(self) -> np.ndarray:
        """1.0 where a pulse has a width, else 0.0, shape (K,)."""
        return (self.pulse_width_us > 0).astype(float)

    @property
    def span_s(self) -> float:
        """Length of the record, s."""
        return float(self.time_s[-1] - self.time_s[0])


Apply = Callable[[Any, dict[str, Any], Scene], Any]


@dataclass(frozen=True)
class Form:
    """One published form of an effect.

    `apply(x, p, scene)` by stage, with x and the result of shape (K,), and p the parameters by name:

    - "pulse_width": pulse widths, µs, to pulse widths that act.
    - "gain": drive f(u), N·m, to drive.
    - "speed": (drive, torque), to a factor on the time constant.
    - "branch": drive, to a list of (drive, factor on the time constant), whose responses add up.
    - "delay": None, to a delay in s.
    - "filter": (torque, its rate) at the ends of the pulse intervals, shape (K + 1,), to the same.
    - "output": torque to torque, each instant by itself.
    - "additive": None, to a torque added at `scene.time_s`.
    - "sensor": torque to torque, last of all.

    Parameters
    ----------
    name : str
        Short id of the form.
    stage : str
        One of `STAGES`.
    equation : str
        For the page.
    parameters : tuple of Parameter
        In the order in which starting values are paired.
    apply : callable
        See above. At the neutral values it returns x itself, bit for bit.
    batched : bool
        Whether `apply` takes x of shape (M, K) and parameters of shape (M, 1); if not, it is called row by row.
    law : dict
        For "speed" alone: column of the compiled law by parameter; `apply` is then not called.
    log_law : tuple of str
        Parameters of which the law takes the logarithm.
    propose : callable or None
        `propose(residual_nm, scene, previous)` gives starting values found in the data: a list of dicts, none where
        there is nothing to start from. `previous` holds the parameters of the form before in a chain.
    restarts : tuple of dict
        Further starts that also set the base's T and ζ (`base.time_constant_s`, `base.damping`): where the base has
        bent its own dynamics to imitate the effect.
    accept : callable or None
        `accept(parameters, scene)`: whether a fit makes sense.
    grows : bool
        The form is the next in a chain: it is tried only while the form before it gained.
    settled : bool
        Its parameters are found in the raw samples, and the target no longer holds it: nothing of it is fitted.
    source : str
        Paper and equation.
    """

    name: str
    stage: str
    equation: str
    parameters: tuple[Parameter, ...]
    apply: Apply | None = None
    batched: bool = False
    law: dict[str, int] = field(default_factory=dict)
    log_law: tuple[str, ...] = ()
    propose: Callable[[np.ndarray, Scene, dict[str, float]], list[dict[str, float]]] | None = None
    grows: bool = False
    accept: Callable[[dict[str, float], Scene], bool] | None = None
    restarts: tuple[dict[str, float], ...] = ()
    settled: bool = False
    source: str = ""

    def starts(self, scene: Scene) -> list[dict[str, float]]:
        """Starting values, one dict a run."""
        on = [p.on(scene) for p in self.parameters]
        runs = max((len(p.start) for p in on), default=1)
        listed = [{p.name: p.start[min(i, len(p.start) - 1)] for p in on} for i in range(runs)]
        return listed + [dict(start) for start in self.restarts]

    def call(self, x: Any, p: dict[str, np.ndarray], scene: Scene) -> Any:
        """`apply` for rows of parameters: x of shape (M, K) (or a tuple of such, or None), p of shape (M, 1)."""
        assert self.apply is not None
        if self.batched:
            return self.apply(x, p, scene)
        rows = next(iter(p.values())).shape[0]
        results = []
        for m in range(rows):
            row = None if x is None else tuple(part[m] for part in x) if isinstance(x, tuple) else x[m]
            results.append(self.apply(row, {name: float(value[m, 0]) for name, value in p.items()}, scene))
        if isinstance(results[0], tuple):
            return tuple(np.stack([result[i] for result in results]) for i in range(len(results[0])))
        return np.stack([np.broadcast_to(np.asarray(result, float), scene.time_s.shape) for result in results])


@dataclass(frozen=True)
class Effect:
    """One physical effect, in one or more forms.

    Parameters
    ----------
    id : str
        As in the contract.
    name : str
        For people.
    forms : tuple of Form
        The published variants; the fit takes the likeliest.
    signature : str
        What it leaves in the residual of a model without it.
    resembles : tuple of str
        Ids of effects that a record often can't tell from it.
    separated_by : str
        The test that tells them apart.
    plain : str
        A paragraph a clinician understands.
    source : str
        Where the physics is described.
    needs : tuple of str
        Columns without which it isn't considered.
    foreseeable : bool
        Whether it can be predicted for rows not fitted (bumps and tremor can't).
    raw : bool
        Whether it is sought at the record's own rate, before averaging.
    band : bool
        Whether it is a narrow band of noise: sought in the residual's spectrum, and part of the noise while others are
        weighed.
    seen : callable or None
        `seen(raw)`: the form and its parameters where the raw samples show the effect beyond doubt, else None; `raw` is
        what `identify.estimation.prepare.inspect` saw. It is then taken as there, before any fit.
    prior : float
        Odds against it beforehand, as a natural logarithm, on top of the common ones.
    """

    id: str
    name: str
    forms: tuple[Form, ...]
    signature: str
    resembles: tuple[str, ...]
    separated_by: str
    plain: str
    source: str = ""
    needs: tuple[str, ...] = ()
    foreseeable: bool = True
    raw: bool = False
    band: bool = False
    seen: Callable[[Any], tuple[str, dict[str, float]] | None] | None = None
    prior: float = 0.0

    @property
    def stage(self) -> str:
        """Where its first form enters."""
        return self.forms[0].stage

    def form(self, name: str) -> Form:
        """A form by its name (the first where the name is empty)."""
        for form in self.forms:
            if form.name == name or not name:
                return form
        raise KeyError(name)
