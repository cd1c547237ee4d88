"""The model of one muscle: recruitment, linear dynamics, effects; to and from MODEL.json."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from stimrig.identify import model_schema
from stimrig.identify.dynamics.linear import Linear, SecondOrder, linear_from_dict
from stimrig.identify.errors import BadModel
from stimrig.identify.json_text import BadJson, json_value, parse
from stimrig.identify.recruitment import Curve
from stimrig.identify.recruitment.bases import basis_from_dict
from stimrig.identify.summary import Sheet, Summarised, estimate, fit_words, held_out_label, parameter_words, quantity
from stimrig.identify.yardstick import repetition_words

if TYPE_CHECKING:
    from stimrig.identify.records.record import Record

SCHEMA_VERSION = "1.0"
LARGEST_TEXT = 16 * 2**20
"""Characters. A model with 1000 knots and all effects has two million."""
try:
    MADE_BY = {"name": "stimrig", "version": version("stimrig")}
except PackageNotFoundError:  # run from its folder, without an installation
    MADE_BY = {"name": "stimrig", "version": "0"}
MOST_PARAMETERS = 4
"""Parameters of an effect that a summary shows."""
WRITTEN_AS_THEY_ARE = ("fit", "residual_tests", "valid_for", "quality", "data", "joint", "extra", "software")


@dataclass(frozen=True)
class Noise:
    """The noise that the fit assumes."""

    white_sd_nm: float = 0.0  # white measurement noise of a sample
    block_sd_nm: float = 0.0  # standard deviation of the noise on the grid of pulses
    ar1: float = 0.0  # correlation of neighbouring pulse intervals; 0 if white noise describes the residual better


@dataclass(frozen=True)
class Covariance:
    """The estimated parameters and their covariance."""

    names: tuple[str, ...]  # ending in the unit: time_constant_s, damping, delay_s, baseline_nm, recruitment_0_nm, …
    values: np.ndarray  # estimates, shape (P,)
    matrix: np.ndarray  # covariance, shape (P, P); units are products of the parameters' units

    def sd(self, name: str) -> float:
        """Standard deviation of a parameter by its name."""
        place = self.names.index(name)
        return float(np.sqrt(max(self.matrix[place, place], 0.0)))


@dataclass(frozen=True, repr=False)
class Model(Summarised):
    """A Hammerstein model, with or without effects. The dicts are those of MODEL.json (`docs/`)."""

    method: str  # id of the method that estimated it
    recruitment: Curve  # f(u), N·m
    linear: Linear  # G, unit gain at DC
    pulse_rate_hz: float  # of the fitted record
    sample_rate_hz: float  # of the fitted record
    baseline_nm: float = 0.0  # torque at rest
    initial: tuple[float, float] = (0.0, 0.0)
    """Torque above the baseline, N·m, and its rate, N·m/s, at the first pulse of the fitted record."""
    noise: Noise = field(default_factory=Noise)  # what the fit assumes
    effects: tuple[dict[str, Any], ...] = ()  # each {"id", "form", "parameters", …}; empty for the plain structure
    covariance: Covariance | None = None  # of all parameters; None if the method gives none
    fit: dict[str, Any] = field(default_factory=dict)
    """fit_percent, held_out_fit_percent, rms_nm, held_out_rms_nm, ceiling_percent, noise_sd_nm and more."""
    residual_tests: dict[str, Any] = field(default_factory=dict)  # whether what is left looks like noise
    valid_for: dict[str, Any] = field(default_factory=dict)  # pulse widths, torques and rates that were fitted
    quality: dict[str, Any] = field(default_factory=dict)  # the verdict, its reasons and its gates
    bands: dict[str, Any] = field(default_factory=dict)  # of both curves, 95 %
    data: dict[str, Any] = field(default_factory=dict)  # the recording: its name, id and SHA-256
    joint: dict[str, Any] = field(default_factory=dict)
    """g(x, ẋ) and h(x, ẋ) as tables with bands (`problem.joint_surface`); empty where the joint was held."""
    reasons: tuple[str, ...] = ()  # for the structure, the number of knots and the noise model
    extra: dict[str, Any] = field(default_factory=dict)  # what the method adds
    model_id: str = ""  # of this version
    created: str = ""  # UTC, ISO 8601
    software: dict[str, Any] = field(default_factory=lambda: dict(MADE_BY))  # name and version

    def predict(self, record: Record) -> np.ndarray:
        """Free-run torque at the record's samples, N·m, shape (N,)."""
        from stimrig.identify.problem.predict import predict  # here: reading a model does not import numba

        return predict(self, record)

    def figures(self) -> dict[str, dict[str, Any]]:
        """Threshold, plateau, saturation, and of a second-order block its parameters: `value`, `sd` and `unit` of each.

        An `sd` is None if the model has no covariance.
        """
        figures = self.recruitment.landmarks(self.curve_covariance)
        if isinstance(self.linear, SecondOrder):
            for name, unit in (("time_constant_s", "s"), ("damping", "1"), ("delay_s", "s")):
                figures[name] = {"value": getattr(self.linear, name), "sd": self._sd(name), "unit": unit}
        return figures

    @property
    def curve_covariance(self) -> np.ndarray | None:
        """Covariance of the recruitment curve's coefficients, N²·m²; None if the model has none."""
        known = self.covariance
        names = [f"recruitment_{place}_nm" for place in range(self.recruitment.basis.size)]
        if known is None or not set(names) <= set(known.names):
            return None
        rows = [known.names.index(name) for name in names]
        return known.matrix[np.ix_(rows, rows)]

    def to_dict(self) -> dict[str, Any]:
        """MODEL.json as a dict of lists, numbers and texts."""
        width, torque = self.recruitment.table()
        level, needed = self.recruitment.inverse()
        rate = self.sample_rate_hz if isinstance(self.linear, SecondOrder) else 1.0 / self.linear.step_s
        b, a, delay = self.linear.discrete(rate)
        return json_value(
            {
                "schema_version": SCHEMA_VERSION,
                "model_id": self.model_id,
                "sample_rate_hz": rate,
                "pulse_rate_hz": self.pulse_rate_hz,
                "record_rate_hz": self.sample_rate_hz,
                "method": self.method,
                "created": self.created,
                "linear": {
                    "b": b,
                    "a": a,
                    "delay_samples": delay,
                    "form": "y[k] = sum_i b[i] w[k - delay_samples - i] - sum_{j>=1} a[j] y[k - j]; w = f(pulse width)",
                }
                | self.linear.to_dict(),
                "recruitment": {
                    "pulse_width_us": width,
                    "torque_nm": torque,
                    "inverse": {"torque_nm": level, "pulse_width_us": needed},
                }
                | self.recruitment.to_dict(),
                "baseline_nm": self.baseline_nm,
                "initial": list(self.initial),
                "noise": vars(self.noise),
                "valid_for": self.valid_for,
                "uncertainty": {
                    "covariance": self.covariance and vars(self.covariance),
                    "bands": self.bands,
                    "figures": self.figures(),
                },
                "effects": self.effects,
                **({"joint": self.joint} if self.joint else {}),
                "fit": self.fit,
                "residual_tests": self.residual_tests,
                "quality": self.quality,
                "reasons": self.reasons,
                "data": self.data,
                "software": self.software,
                "extra": self.extra,
            }
        )

    def to_json(self, indent: int | None = 1) -> str:
        """MODEL.json as text.

        Parameters
        ----------
        indent : int, optional
            Spaces for each level; None: one line.
        """
        return json.dumps(self.to_dict(), indent=indent, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Model:
        """The model that `to_dict` wrote. Raises BadModel: a key is missing, or its value is not valid."""
        if not isinstance(data, dict):
            raise BadModel("not a JSON object", fix="Give a file written by `stimrig fit -o`.")
        version = str(data.get("schema_version", ""))[:20]
        if version.split(".")[0] != SCHEMA_VERSION.split(".")[0]:
            message = f"schema version {version or 'missing'}, this software reads {SCHEMA_VERSION}"
            raise BadModel(message, place="schema_version", fix="Fit the record again with this version.")
        model_schema.check_model(data)
        try:
            model = _from_dict(data)
            with np.errstate(all="ignore"):
                finite = np.isfinite(model.recruitment.table()[1]).all()
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
            cause = " ".join(f"{type(error).__name__} {error}".split())[:100]
            raise BadModel(f"the parts do not match ({cause})", fix=model_schema.FIX) from error
        if not finite:
            raise BadModel("the curve is not finite", place="recruitment.basis", fix=model_schema.FIX)
        for index, entry in enumerate(model.effects):
            _check_effect(entry, f"effects.{index}.parameters", model.recruitment.basis.largest_us)
        return model

    @classmethod
    def from_json(cls, text: str | bytes) -> Model:
        """The model in a MODEL.json text.

        Raises BadModel: not JSON, too long, too deep, with a duplicate key or an invalid number, or not a model.
        """
        if len(text) > LARGEST_TEXT:
            raise BadModel(f"more than {LARGEST_TEXT} characters", fix="Give a file written by `stimrig fit -o`.")
        try:
            return cls.from_dict(parse(text))
        except BadJson as error:
            raise BadModel(str(error), fix=model_schema.FIX) from error

    def with_(self, **changes: Any) -> Model:
        """A copy of the model with some fields changed."""
        return replace(self, **changes)

    def _sheet(self) -> Sheet:
        fit, known = self.fit, self.valid_for
        named = ", ".join(str(effect["id"]) for effect in self.effects) or "no effects"
        width_us, torque_nm = self.recruitment.table()
        top_us = float(width_us[np.argmax(np.abs(torque_nm))])
        marks = self.figures()
        low, largest, high = (
            estimate(marks[name]["value"], marks[name]["sd"], marks[name]["unit"])
            for name in ("threshold_us", "plateau_nm", "saturation_us")
        )
        rows = [
            ("fit", fit_words(fit)),
            (held_out_label(fit), fit_words(fit, "held_out_")),
            ("noise", f"{quantity(self.noise.white_sd_nm, 'N·m')} white, sd of a sample"),
            ("repetition", repetition_words(fit)),
            ("dynamics", self._dynamics()),
            ("recruitment", f"largest {largest}, at {quantity(top_us, 'µs')}; 5 % of it at {low}, 95 % at {high}"),
            ("baseline", estimate(self.baseline_nm, self._sd("baseline_nm"), "N·m")),
            *[(str(effect["id"]), _some_parameters(effect.get("parameters", {}))) for effect in self.effects],
        ]
        if "pulse_width_us" in known and "pulse_rate_hz" in known:
            widths, rates = _span(known["pulse_width_us"], "µs"), _span(known["pulse_rate_hz"], "pulses/s")
            rows.append(("valid for", f"{widths}, {rates}"))
        if self.quality:
            reasons = [f"{self.quality.get('verdict', '')}: {self.quality.get('words', '')}"]
            reasons += self.quality.get("reasons", [])[1:]
            rows += [("quality", reasons[0]), *(("", reason) for reason in reasons[1:])]
        rows.append(("made", f"{self.created} from {self.data.get('name') or 'a record without a name'}"))
        unseen = f"{held_out_label(fit)} {quantity(fit.get('held_out_fit_percent'), '%')}"
        figures = f"fit {quantity(fit.get('fit_percent'), '%')}, {unseen}"
        return Sheet(f"Model {self.model_id[:8]}, {self.method}, {named}: {figures}", tuple(rows))

    def _dynamics(self) -> str:
        linear = self.linear
        if isinstance(linear, SecondOrder):
            return (
                f"time constant {estimate(linear.time_constant_s, self._sd('time_constant_s'), 's')}, "
                f"damping {estimate(linear.damping, self._sd('damping'), '1')}, "
                f"delay {estimate(1e3 * linear.delay_s, self._sd('delay_s', 1e3), 'ms')}"
            )
        step = quantity(1e3 * linear.step_s, "ms")
        return f"order {len(linear.a) - 1} in steps of {step}, delay {quantity(linear.delay_samples, 'steps')}"

    def _sd(self, name: str, factor: float = 1.0) -> float | None:
        known = self.covariance
        return factor * known.sd(name) if known is not None and name in known.names else None


def _from_dict(data: dict[str, Any]) -> Model:
    recruitment, uncertainty = data["recruitment"], data.get("uncertainty") or {}
    basis = basis_from_dict(recruitment["basis"])
    coefficients = np.asarray(recruitment["basis"]["coefficients_nm"], float)
    if coefficients.shape != (basis.size,):
        message = f"{coefficients.size} coefficients for a basis of {basis.size}"
        raise BadModel(message, place="recruitment.basis.coefficients_nm")
    covariance, known = None, uncertainty.get("covariance")
    if known:
        values, matrix = np.asarray(known["values"], float), np.asarray(known["matrix"], float)
        covariance, size = Covariance(tuple(known["names"]), values, matrix), len(known["names"])
        if values.shape != (size,) or matrix.shape != (size, size):
            message, place = "names, values and matrix differ in size", "uncertainty.covariance"
            raise BadModel(message, place=place, fix=model_schema.FIX)
    torque_nm, rate_nm_s = data["initial"][:2]
    return Model(
        method=str(data["method"]),
        recruitment=Curve(basis, coefficients),
        linear=linear_from_dict(data["linear"]),
        pulse_rate_hz=float(data["pulse_rate_hz"]),
        sample_rate_hz=float(data.get("record_rate_hz", data["sample_rate_hz"])),
        baseline_nm=float(data["baseline_nm"]),
        initial=(float(torque_nm), float(rate_nm_s)),
        noise=Noise(**{key: data["noise"][key] for key in vars(Noise()) if data.get("noise", {}).get(key) is not None}),
        effects=tuple(data["effects"]),
        covariance=covariance,
        bands=uncertainty.get("bands", {}),
        reasons=tuple(data.get("reasons", ())),
        model_id=str(data.get("model_id", "")),
        created=str(data.get("created", "")),
        **{name: data.get(name, {}) for name in WRITTEN_AS_THEY_ARE},
    )


def _check_effect(entry: dict[str, Any], place: str, largest_us: float) -> None:
    """Refuse parameters that no fit gives: some would cause a division by zero. Unknown effects are not checked."""
    from stimrig.identify.effects import known_form  # imported here, so that reading a model does not import numba
    from stimrig.identify.effects.base import Scene

    known = known_form(entry)
    if known is None:
        return
    effect, form = known
    settings = entry["settings"]
    scene = Scene(
        time_s=np.array([0.0, model_schema.PLAUSIBLE]),  # the length of the fitted record is not in the file
        pulse_width_us=np.zeros(2),
        step_s=1.0,
        scale_nm=settings["scale_nm"],
        largest_us=largest_us,
        zero_nm=settings["zero_nm"],
    )
    wanted = {}
    for p in (p.on(scene) for p in form.parameters):
        lower, upper = p.lower, p.upper
        if effect.band or form.fixed:  # estimated outside the fit, without bounds
            lower, upper = 1e-6 if p.scale == "log" else -model_schema.PLAUSIBLE, model_schema.PLAUSIBLE
        slack = 1e-6 * (upper - lower) if np.isfinite(upper - lower) else 0.0
        wanted[p.name] = {"type": "number", "minimum": lower - slack, "maximum": upper + slack}
    values = {name: model_schema.parameter_value(value) for name, value in entry["parameters"].items()}
    model_schema.check(values, {"type": "object", "properties": wanted, "x-needed": list(wanted)}, place)


def _some_parameters(parameters: dict[str, Any]) -> str:
    words = parameter_words(parameters, MOST_PARAMETERS)
    more = len(parameters) - len(words)
    return ", ".join([*words, *([f"{more} more parameters"] if more else [])])


def _span(value: Any, unit: str) -> str:
    low, high = value if isinstance(value, list | tuple) else (value, value)
    return f"{quantity(low, '')} to {quantity(high, unit)}"
