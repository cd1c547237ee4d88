"""The model of several muscles at one joint: one whole model for each, and what they do to each other."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

import numpy as np

from stimrig.identify import model_schema
from stimrig.identify.dynamics.grid import Grid
from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.json_text import BadJson, json_value, parse
from stimrig.identify.model import LARGEST_TEXT, SCHEMA_VERSION, Model, made_by
from stimrig.identify.muscles.interplay import Other
from stimrig.identify.muscles.problem import Acting, JointProblem, drive_form
from stimrig.identify.muscles.record import MOST, NAME, RESERVED, Channel, JointRecord
from stimrig.identify.simulation.predict import fingerprint, problem_of, refuse_rate
from stimrig.identify.summary import Sheet, Summarised, quantity

KIND = "joint"
WORDS = ("name", "muscle", "side", "electrode")
WRITTEN = ("fit", "quality", "data", "valid_for")


@dataclass(frozen=True, repr=False)
class JointModel(Summarised):
    """Several muscles at one joint.

    The torque is that of all muscles, each relative to its zero, and one zero; `interplay` says what they do to each
    other. Each muscle's delay counts from its own pulses.
    """

    channels: tuple[Channel, ...]  # what is known of each
    models: tuple[Model, ...]  # of each channel, in order
    interplay: tuple[dict[str, Any], ...] = ()
    """Each {"id", "from", "to", "form", "equation", "parameters"}; `from` and `to` are missing where it is of the
    joint."""
    fit: dict[str, Any] = field(default_factory=dict)
    """As of one model, and `alone` by channel and `both`: the error on held-out pulses while those muscles moved."""
    quality: dict[str, Any] = field(default_factory=dict)  # the verdict and its reasons
    valid_for: dict[str, Any] = field(default_factory=dict)  # what was fitted
    data: dict[str, Any] = field(default_factory=dict)  # the recording
    reasons: tuple[str, ...] = ()  # for the structure
    model_id: str = ""  # of this version
    created: str = ""  # UTC, ISO 8601
    software: dict[str, Any] = field(default_factory=made_by)  # name and version

    @property
    def names(self) -> tuple[str, ...]:
        """Of the channels."""
        return tuple(channel.name for channel in self.channels)

    @property
    def baseline_nm(self) -> float:
        """Torque at rest, N·m."""
        return self.models[0].baseline_nm

    @property
    def pulse_rate_hz(self) -> float:
        """Of each channel."""
        return self.models[0].pulse_rate_hz

    def of(self, name: str) -> Model:
        """The model of a channel. Raises BadRequest: there is none of that name.

        Parameters
        ----------
        name : str
            Of a channel.

        Returns
        -------
        Model
        """
        if name not in self.names:
            raise BadRequest(f"no channel {name!r}", place="channel", fix=f"Use one of {', '.join(self.names)}.")
        return self.models[self.names.index(name)]

    def acting(self) -> list[tuple[Acting, dict[str, float]]]:
        """Each interplay with its parameters.

        Returns
        -------
        list[tuple[Acting, dict]
        """
        found = []
        for entry in self.interplay:
            ends = f":{entry['from']}>{entry['to']}" if "from" in entry else ""
            values = {name: float(model_schema.parameter_value(p)) for name, p in entry["parameters"].items()}
            found.append((Acting.of(f"{entry['id']}{ends}:{entry['form']}", self.names), values))
        return found

    def predict(self, record: JointRecord) -> np.ndarray:
        """Free-run torque at the record's samples, N·m, shape (N,).

        Parameters
        ----------
        record : JointRecord
            The measurement.

        Returns
        -------
        ndarray
        """
        return predict(self, record)

    def to_dict(self) -> dict[str, Any]:
        """As a file of a joint model holds it.

        Returns
        -------
        dict
        """
        channels = [
            channel.to_dict() | {"model": model.to_dict()}
            for channel, model in zip(self.channels, self.models, strict=True)
        ]
        head = {"schema_version": SCHEMA_VERSION, "kind": KIND, "model_id": self.model_id, "created": self.created}
        told = {name: getattr(self, name) for name in WRITTEN}
        tail = {"pulse_rate_hz": self.pulse_rate_hz, "baseline_nm": self.baseline_nm, "reasons": self.reasons}
        whole = head | {"channels": channels, "interplay": self.interplay} | told | tail | {"software": self.software}
        return json_value(whole)

    def to_json(self, indent: int | None = 1) -> str:
        """The same as text.

        Parameters
        ----------
        indent : int, optional
            Spaces for each level; None: one line.

        Returns
        -------
        str
        """
        return json.dumps(self.to_dict(), indent=indent, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_dict(cls, data: Any) -> JointModel:
        """The model that `to_dict` wrote. Raises BadModel: a key is missing, or its value is not valid.

        Parameters
        ----------
        data : object
            What `to_dict` gave.

        Returns
        -------
        JointModel
        """
        if not is_joint_model(data):
            raise BadModel("not the model of a joint", place="kind", fix="Give a file of several muscles.")
        try:
            channels = tuple(
                Channel(offset_s=float(one["offset_s"]), **{name: str(one[name]) for name in WORDS})
                for one in data["channels"]
            )
            models = tuple(Model.from_dict(one["model"]) for one in data["channels"])
            found = cls(
                channels,
                models,
                tuple(dict(one) for one in data.get("interplay", ())),
                **{name: dict(data.get(name) or {}) for name in WRITTEN},
                reasons=tuple(str(one) for one in data.get("reasons", ())),
                model_id=str(data.get("model_id", "")),
                created=str(data.get("created", "")),
            )
            found.check()
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            said = " ".join(f"{type(error).__name__} {error}".split())[:100]
            raise BadModel(f"the parts do not match ({said})", fix=model_schema.FIX) from error
        except BadRequest as error:
            raise BadModel(error.message, place=error.place, fix=error.fix) from error
        return found

    def check(self) -> None:
        """Refuse what no fit gives. Raises BadModel, BadRequest."""
        rates = {model.pulse_rate_hz for model in self.models}
        interval_s = 1.0 / max(rates)
        offsets_s = [channel.offset_s for channel in self.channels]
        known = all(re.fullmatch(NAME, name) and name not in RESERVED for name in self.names)
        if not 2 <= len(set(self.names)) == len(self.names) <= MOST or not known or len(rates) > 1:
            raise BadModel("channels that make no joint", place="channels", fix=model_schema.FIX)
        if not all(-interval_s < offset_s < interval_s for offset_s in offsets_s):
            raise BadModel("an offset longer than a pulse interval", place="channels", fix=model_schema.FIX)
        if not all(isinstance(model.linear, SecondOrder) for model in self.models):
            raise BadModel("a muscle without second-order dynamics", place="channels", fix=model_schema.FIX)
        keys = [key_of(entry) for entry in self.interplay]
        if len(set(keys)) < len(keys):
            raise BadModel("an interplay twice", place="interplay", fix=model_schema.FIX)
        told = [self.fit.get("alone") or {}, self.fit.get("both") or {}]
        if not all(isinstance(one, dict) for one in (*told, *dict(told[0]).values())):
            raise BadModel("no errors of each muscle", place="fit", fix=model_schema.FIX)
        if not isinstance(self.data.get("notes", []), list):
            raise BadModel("no list of notes", place="data", fix=model_schema.FIX)
        for acting, values in self.acting():
            known = {p.name: p for p in _parameters_of(acting)}
            if set(values) != set(known):
                raise BadModel("parameters of another form", place=f"interplay, {acting.interplay.id}")
            for name, value in values.items():
                if not known[name].lower <= value <= known[name].upper:
                    raise BadModel(f"{name} {value:g} is out of range", place=f"interplay, {acting.interplay.id}")

    @classmethod
    def from_json(cls, text: str | bytes) -> JointModel:
        """The model in a text. Raises BadModel: not JSON, too long or too deep, or not the model of a joint.

        Parameters
        ----------
        text : str or bytes
            Of a MODEL.json.

        Returns
        -------
        JointModel
        """
        if len(text) > MOST_TEXTS * LARGEST_TEXT:
            raise BadModel("too long a text", fix=model_schema.FIX)
        try:
            return cls.from_dict(parse(text))
        except BadJson as error:
            raise BadModel(str(error), fix=model_schema.FIX) from error

    def with_(self, **changes: Any) -> JointModel:
        """A copy with some fields changed.

        Parameters
        ----------
        **changes
            Fields with their new values.

        Returns
        -------
        JointModel
        """
        return replace(self, **changes)

    def named(self) -> JointModel:
        """With a new id, and made now.

        Returns
        -------
        JointModel
        """
        return self.with_(model_id=str(uuid4()), created=datetime.now(UTC).isoformat(timespec="seconds"))

    def _sheet(self) -> Sheet:
        fit = self.fit
        rows = [("fit", f"{quantity(fit.get('fit_percent'), '%')}, error {quantity(fit.get('rms_nm'), 'N·m')}")]
        rows.append(("held out", f"error {quantity(fit.get('held_out_rms_nm'), 'N·m')}"))
        for name, own in (fit.get("alone") or {}).items():
            rows.append((f"{name} alone", f"held-out error {quantity(own.get('held_out_rms_nm'), 'N·m')}"))
        if both := fit.get("both"):
            rows.append(("both", f"held-out error {quantity(both.get('held_out_rms_nm'), 'N·m')}"))
        for name, model in zip(self.names, self.models, strict=True):
            rows.append((name, _line(model)))
        rows += [(key_of(one), _values(one)) for one in self.interplay]
        if self.quality:
            rows.append(("quality", str(self.quality.get("words", self.quality.get("verdict", "")))))
        rows += [("note", str(note)) for note in self.data.get("notes", ())]
        return Sheet(f"Model {self.model_id[:8]} of {' and '.join(self.names)}", tuple(rows))


MOST_TEXTS = 8


def key_of(entry: Mapping[str, Any]) -> str:
    """What an interplay is called: "co_contraction", or "cross_talk:biceps>triceps"."""
    return f"{entry['id']}:{entry['from']}>{entry['to']}" if "from" in entry else str(entry["id"])


def _line(model: Model) -> str:
    named = ", ".join(str(effect["id"]) for effect in model.effects) or "no effects"
    plateau = model.figures()["plateau_nm"]
    return f"largest {quantity(plateau['value'], 'N·m')}, {named}"


def _values(entry: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {quantity(p['value'], p.get('unit', ''))}" for name, p in entry["parameters"].items())


def _parameters_of(acting: Acting) -> Sequence[Any]:
    form = acting.interplay.form(acting.form)
    if acting.between is None:
        return form.parameters
    nothing = np.zeros(1)
    return form.make(Other((nothing, nothing), 0.0)).parameters


def is_joint_model(data: Any) -> bool:
    """Whether a JSON document is the model of a joint.

    Parameters
    ----------
    data : object
        A JSON document.

    Returns
    -------
    bool
    """
    return isinstance(data, dict) and data.get("kind") == KIND


def joint_fingerprint(record: JointRecord) -> str:
    """Of all channels' pulses and the torque."""
    return "+".join(fingerprint(one)[:32] for one in record.records)


def predict(model: JointModel, record: JointRecord) -> np.ndarray:
    """Torque that the model predicts for the record's pulse widths, N·m, shape (N,). No measured torque is used.

    Raises BadModel: as `stimrig.identify.predict`. BadRequest: the record has other channels.

    Parameters
    ----------
    model : JointModel
        The model.
    record : JointRecord
        The measurement.

    Returns
    -------
    ndarray
    """
    return whole_and_parts(model, record)[0]


def parts(model: JointModel, record: JointRecord) -> dict[str, np.ndarray]:
    """Torque of each muscle by itself, without the zero, N·m, shape (N,).

    Parameters
    ----------
    model : JointModel
        The model.
    record : JointRecord
        The measurement.

    Returns
    -------
    dict
    """
    return whole_and_parts(model, record)[1]


def whole_and_parts(model: JointModel, record: JointRecord) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Both at once. Raises as `predict`.

    Parameters
    ----------
    model : JointModel
        The model.
    record : JointRecord
        The measurement.

    Returns
    -------
    tuple[ndarray, dict[str, ndarray]]
    """
    problem, theta = _problem(model, record)
    whole, own = problem.whole_and_parts(theta)
    return whole, dict(zip(model.names, own, strict=True))


def _problem(model: JointModel, record: JointRecord) -> tuple[JointProblem, np.ndarray]:
    missing = set(model.names) ^ set(record.names)
    if missing:
        fix = f"The model has {', '.join(model.names)}."
        raise BadRequest(f"the record has the channels {', '.join(record.names)}", place="channels", fix=fix)
    order = [record.names.index(name) for name in model.names]
    grids = [record.grids[place] for place in order]
    acting = model.acting()
    own = model.data.get("fingerprint") == joint_fingerprint(record)
    moved = [_of_train(one, grid) for one, grid in zip(model.models, grids, strict=True)]
    bases = [one.recruitment.basis for one in moved]
    problems, thetas = [], []
    for place, (one, grid) in enumerate(zip(moved, grids, strict=True)):
        further = [
            (replace(drive_form(acts, grids, bases), name=f"{acts.interplay.id}_{number}"), list(values.values()))
            for number, (acts, values) in enumerate(acting)
            if acts.between is not None and acts.between[1] == place
        ]
        problem, theta = problem_of(one, grid, further, one.extra.get(KIND))
        values = problem.physical(theta)
        if own:
            values[list(problem.initials)[:2]] = problem.setup.sign * np.array(one.initial)
        if place:
            values[list(problem.baselines)] = 0.0
        problems.append(problem)
        thetas.append(problem.from_physical(values))
    joint = [(acts.interplay, acts.interplay.form(acts.form)) for acts, _ in acting if acts.between is None]
    own_values = [value for acts, values in acting if acts.between is None for value in values.values()]
    return JointProblem(problems, joint), np.r_[np.concatenate(thetas), own_values]


def _of_train(model: Model, grid: Grid) -> Model:
    """The model with its delay counted from the first channel's slots.

    Raises BadModel: its record's rate differs too much.
    """
    refuse_rate(model, grid.record)
    assert isinstance(model.linear, SecondOrder)
    return model.with_(linear=replace(model.linear, delay_s=model.linear.delay_s + grid.offset_s))
