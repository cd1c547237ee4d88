"""The verbs on a record of several muscles at one joint: what one muscle's say, for all of them."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import LARGEST_MODEL_BYTES, number, percent, say, say_json, table, write, writing
from stimrig.api.progress_bar import progress_bar

STRUCTURE = "co_contraction, cross_talk:FROM>TO, or CHANNEL.EFFECT"


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


def load_model(path: Path) -> Any:
    """A model of several muscles. Raises InputError: the file cannot be read, or holds none."""
    from stimrig.identify import muscles

    try:
        with path.open("rb") as file:
            return muscles.JointModel.from_json(file.read(LARGEST_MODEL_BYTES))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Give a file written by `stimrig fit -o`.") from error
    except identify.IdentifyError as error:
        raise InputError(f"{path}: {error}") from error


def parted(effects: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """What `--effects` names: by channel its effects, and the interplay. Raises InputError: neither."""
    from stimrig.identify.muscles import interplay

    own: dict[str, list[str]] = {}
    between: list[str] = []
    for name in effects:
        channel, dot, effect = name.partition(".")
        if name.partition(":")[0] in interplay.registry():
            between.append(name)
        elif dot and effect:
            own.setdefault(channel, []).append(effect)
        else:
            raise InputError(f"--effects {name}: with several muscles give {STRUCTURE}.")
    return own, between


def fit(data: Sequence[Path], effects: Sequence[str], output: Path | None, as_json: bool, **unknown: Any) -> None:
    """As `stimrig fit`."""
    from stimrig.identify import muscles

    record = load(data, **unknown)
    own, between = parted(effects)
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


def predict(model_json: Path, data: Path, output: Path, as_json: bool, **unknown: Any) -> None:
    """As `stimrig predict`; with a column for each muscle's share."""
    import numpy as np

    from stimrig.identify import muscles
    from stimrig.identify.estimation.fit_statistics import best_fit_percent, rms

    record, model = load([data], **unknown), load_model(model_json)
    predicted = muscles.predict(model, record)
    found = {"time_s": record.time_s, "torque_nm": record.torque_nm, "predicted_torque_nm": predicted}
    found |= {f"{name}_torque_nm": torque for name, torque in muscles.parts(model, record).items()}
    with writing(output) as place:
        np.savetxt(place, np.column_stack(list(found.values())), "%.9g", ",", header=",".join(found), comments="")
    reached, error = best_fit_percent(record.torque_nm, predicted), rms(record.torque_nm - predicted)
    if as_json:
        say_json({"output": str(output), "rows": len(predicted), "fit_percent": reached, "rms_nm": error})
        return
    say(f"{output}: {len(predicted)} rows, fit {percent(reached)} over the whole record, rms {number(error, 4)} N·m")


def compare(model_json: Path, data: Sequence[Path], as_json: bool, **unknown: Any) -> None:
    """As `stimrig compare`: the errors by segment, and while each muscle moved alone and all did."""
    from stimrig.identify import muscles

    found = muscles.compare(load_model(model_json), load(data, **unknown))
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
