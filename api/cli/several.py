"""The verbs on a record of several muscles at one joint: what one muscle's say, for all of them."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cli import terminal
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import number, percent, say, say_json, table, write
from stimrig.api.progress_bar import progress_bar

STRUCTURE = "co_contraction, 'cross_talk:FROM>TO' with the quotes, or CHANNEL.EFFECT"


def is_joint(data: Sequence[Path]) -> bool:
    """Whether a verb's DATA are the pulses of several channels; a file that cannot be read is left to the verb."""
    from stimrig.identify import muscles

    with contextlib.suppress(identify.IdentifyError, OSError):
        return any(muscles.is_joint(path) for path in data)
    return False


def load(data: Sequence[Path], **unknown: Any) -> Any:
    """The record. Raises InputError: several files, or an option that these records do not have."""
    from stimrig.identify import muscles

    if len(data) > 1:
        raise InputError(f"{data[1]}: recordings of several muscles are not joined. Give one.")
    refuse(**unknown)
    return muscles.read(data[0])


def refuse(**unknown: Any) -> None:
    """Raise InputError for the first option that was given although several muscles do not have it."""
    for name, value in unknown.items():
        if value:
            raise InputError(f"--{name.replace('_', '-')} is for records of one muscle. Leave it out.")


def load_model(path: Path, usage: str = "") -> Any:
    """A model of several muscles. Raises InputError: as `terminal.load_model`."""
    from stimrig.identify import muscles

    return terminal.load_model(path, usage, muscles.JointModel.from_json)


def fit(data: Sequence[Path], effects: Sequence[str], output: Path | None, as_json: bool, **unknown: Any) -> None:
    """As `stimrig fit`."""
    from stimrig.identify import muscles
    from stimrig.identify.muscles.verbs import parted

    record = load(data, **unknown)
    own, between, neither = parted(effects, record.names)
    if neither:
        raise InputError(f"--effects {neither[0]}: with several muscles give {STRUCTURE}.")
    with progress_bar() as progress:
        model = muscles.fit(record, own, between, progress)
    _told(model, output, as_json)


def _told(model: Any, output: Path | None, as_json: bool) -> None:
    if output is not None:
        keep(output, model)
    if as_json:
        say_json(model.to_dict())
        return
    say(str(model), *([f"written to {output}"] if output else []))


def keep(output: Path, model: Any) -> None:
    """Write a model. Raises InputError: as a MAT file, or it cannot be written."""
    if output.suffix.lower() == ".mat":
        raise InputError(f"{output}: a model of several muscles has no MAT file. Give a name that ends in .json.")
    write(output, model.to_json())


def predict(model_json: Path, data: Path, usage: str, **unknown: Any) -> tuple[Any, dict[str, Any]]:
    """The record, and the columns of `stimrig predict`, with one for each muscle's share."""
    from stimrig.identify import muscles

    record, model = load([data], **unknown), load_model(model_json, usage)
    predicted, own = muscles.whole_and_parts(model, record)
    return record, {"predicted_torque_nm": predicted, **{f"{name}_torque_nm": torque for name, torque in own.items()}}


def compare(model_json: Path, data: Sequence[Path], as_json: bool, **unknown: Any) -> None:
    """As `stimrig compare`: the errors by segment, and while each muscle moved alone and all did."""
    from stimrig.identify import muscles

    found = muscles.compare(load_model(model_json, "compare MODEL.json DATA"), load(data, **unknown))
    if as_json:
        say_json(found)
        return
    rows = [(str(row["segment"]), percent(row["fit_percent"]), number(row["rms_nm"], 4)) for row in found["segments"]]
    rows += [(f"{name} alone", "", number(own["held_out_rms_nm"], 4)) for name, own in found["alone"].items()]
    rows.append(("both", "", number(found["both"]["held_out_rms_nm"], 4)))
    head = f"fit {percent(found['fit_percent'])}, error {number(found['rms_nm'], 4)} N·m"
    say(f"{head}, noise {number(found['noise_sd_nm'], 4)} N·m", "", *table(("where", "fit", "error N·m"), rows))


def diagnose(data: Sequence[Path], model_json: Path | None, as_json: bool, **unknown: Any) -> None:
    """As `stimrig diagnose`."""
    from stimrig.identify import muscles

    record, model = load(data, **unknown), None if model_json is None else load_model(model_json)
    with progress_bar() as progress:
        found = muscles.diagnose(record, model, progress)
    say_json(found.to_dict()) if as_json else say(str(found), *_words(found.missing))


def _words(missing: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = []
    for row in missing:
        lines += ["", f"{row['name']}: {row['plain']}", f"  next experiment: {row['next_experiment']}"]
    return lines


def improve(data: Sequence[Path], model_json: Path | None, output: Path | None, as_json: bool, **unknown: Any) -> None:
    """As `stimrig improve`."""
    from stimrig.identify import muscles

    record, model = load(data, **unknown), None if model_json is None else load_model(model_json)
    with progress_bar() as progress:
        found = muscles.improve(record, model, progress)
    if output is not None:
        keep(output, found.models[-1])
    if as_json:
        told = found.to_dict()
        del told["models"]
        say_json(told)
        return
    refused = [f"not added      {row['name']}: {row['reason']}" for row in found.refused[:3]]
    say(str(found), *refused, *([f"written to     {output}"] if output else []))
