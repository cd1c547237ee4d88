"""The library of stimulation sequences: one file each, found by looking into this folder.

A sequence is a module with three parts:

- `Settings`: a pydantic model, units in the names.
- `pulse_count(settings, pulse_rate_hz)`: the number of pulses (those of 0 µs included), computed without building them,
  so that too long a sequence is refused before it is built; not needed where the settings have `duration_s`.
- `pulse_widths(settings, pulse_rate_hz) -> ndarray`: a pure function that returns one width in µs for each pulse.

The module's name is the sequence's id. To add a sequence, add a file. A sequence that jumps between levels by design
declares `JUMPS = True`, or has a setting `jumps` if the caller decides.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from functools import cache
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from stimrig.rig.errors import PlanError
from stimrig.rig.messages import SequenceInfo


class SequenceSettings(BaseModel):
    """Base of every sequence's settings: unknown names, NaN and infinities are refused.

    Types are strict: `true` is not a duration, and `"5"` is not a width.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)


class Sequence(Protocol):
    """Interface of a module in this folder."""

    Settings: type[SequenceSettings]

    @staticmethod
    def pulse_widths(settings: Any, pulse_rate_hz: float) -> NDArray[np.float64]: ...


@cache
def library() -> dict[str, Sequence]:
    names = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))
    return {name: cast(Sequence, importlib.import_module(f"{__name__}.{name}")) for name in names}


def find(sequence_id: str) -> Sequence:
    """The sequence of that id. Raises PlanError: there is no sequence of that id; the message lists the known ones."""
    try:
        return library()[sequence_id]
    except KeyError:
        raise PlanError(f"sequence {sequence_id!r} is unknown; use one of {', '.join(library())}") from None


def settings_of(sequence_id: str, settings: dict[str, Any]) -> SequenceSettings:
    """Checked settings of a sequence. Raises PlanError: names the first wrong setting and what is expected."""
    model = find(sequence_id).Settings
    try:
        return model.model_validate(settings)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "settings"
        known = ", ".join(model.model_fields) or "none"
        raise PlanError(f"{sequence_id}.{place}: {first['msg']} (settings: {known})") from None


def described() -> list[SequenceInfo]:
    """Every sequence with what its file says of it, and its settings as JSON Schema."""
    return [
        SequenceInfo(
            id=name,
            description=" ".join((inspect.getdoc(sequence) or "").partition("\n\n")[0].split()),
            settings=sequence.Settings.model_json_schema(),
        )
        for name, sequence in library().items()
    ]


def build(sequence_id: str, settings: dict[str, Any], pulse_rate_hz: float) -> NDArray[np.float64]:
    """Pulse widths in µs, one for each pulse, of a sequence with settings given as a dictionary."""
    checked = settings_of(sequence_id, settings)
    try:
        return find(sequence_id).pulse_widths(checked, pulse_rate_hz)
    except ValueError as error:
        raise PlanError(f"{sequence_id}: {error}") from None


def jumps(sequence_id: str, settings: dict[str, Any]) -> bool:
    """Return whether the width may rise to any allowed level within one pulse."""
    checked = settings_of(sequence_id, settings)
    return bool(getattr(find(sequence_id), "JUMPS", False) or getattr(checked, "jumps", False))


def pulse_count(sequence_id: str, settings: dict[str, Any], pulse_rate_hz: float) -> int:
    checked: Any = settings_of(sequence_id, settings)
    count = getattr(find(sequence_id), "pulse_count", None)
    return pulses_in(checked.duration_s, pulse_rate_hz) if count is None else count(checked, pulse_rate_hz)


def pulses_in(duration_s: float, pulse_rate_hz: float) -> int:
    """Number of pulses in a duration, to the nearest."""
    return round(duration_s * pulse_rate_hz)
