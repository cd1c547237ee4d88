"""What the verbs of the command line share: reading what is asked for, and saying what was found."""

from __future__ import annotations

import contextlib
import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.whole_file import whole_path

LARGEST_MODEL_BYTES = 32 * 2**20

DATA_HELP = (
    "sealed recording (HDF5); CSV file with the columns time_s,pulse_width_us,torque_nm,segment; or another tool's "
    "table, MAT or Parquet file"
)
Json = Annotated[bool, typer.Option("--json", help="one JSON object on standard output, nothing else there")]
Data = Annotated[Path, typer.Argument(help=DATA_HELP, metavar="DATA", show_default=False)]
SeveralData = Annotated[
    list[Path],
    typer.Argument(
        help=f"{DATA_HELP}. Several are joined: recordings of one muscle, each a part of one record",
        metavar="DATA…",
        show_default=False,
    ),
]
ColumnMap = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        help="a column of another tool's file and its unit, such as torque_nm=Drehmoment:Nm; once for each column that "
        "is not called as ours",
        metavar="COLUMN=NAME:UNIT",
        show_default=False,
    ),
]
Html = Annotated[Path | None, typer.Option(help="write a report with charts here")]
LastModel = Annotated[Path | None, typer.Option("-o", "--output", help="write the last MODEL.json, or MODEL.mat")]
ModelFile = Annotated[
    Path, typer.Argument(help="MODEL.json of `stimrig fit -o`", metavar="MODEL.json", show_default=False)
]
HeldModel = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="begin with this model's structure: its effects, their numbers fitted anew to DATA; default: the plain "
        "structure, a recruitment curve f(u) and then second-order dynamics G, without effects",
        metavar="MODEL.json",
        show_default=False,
    ),
]


def given(**options: Any) -> dict[str, Any]:
    """The options that somebody gave; of the others the environment is asked."""
    return {name: value for name, value in options.items() if value is not None}


def names(text: str | None) -> tuple[str, ...]:
    """A comma-separated list."""
    return tuple(part.strip() for part in (text or "").split(",") if part.strip())


def load_model(path: Path, usage: str = "") -> Any:
    """A model from its file; `usage`: of a verb that takes it before a recording.

    Raises InputError: the file cannot be read, or holds no model.
    """
    if path.suffix.lower() == ".mat":
        raise InputError(f"{path}: a MAT file is for other tools. Give the MODEL.json of the same fit.")
    try:
        with path.open("rb") as file:
            return identify.Model.from_json(file.read(LARGEST_MODEL_BYTES))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Give a file written by `stimrig fit -o`.") from error
    except identify.IdentifyError as error:
        with contextlib.suppress(identify.IdentifyError):
            identify.read(path)
            fix = f"The model comes first: stimrig {usage}." if usage else "Give a file written by `stimrig fit -o`."
            raise InputError(f"{path}: this is a recording, not a model. {fix}") from error
        raise InputError(f"{path}: {error}") from error


def load_record(data: Sequence[Path], columns: list[str] | None = None, effects: Sequence[str] = ()) -> Any:
    """A record from its file, or from several as one; what was assumed goes to standard error.

    Raises InputError: a file is named twice. IdentifyError: one cannot be read, they do not go together, or one lacks
    what one of the `effects` needs.
    """
    from stimrig.api import record_files

    twice = [path for number, path in enumerate(data) if path in data[:number]]
    if twice:
        raise InputError(f"{twice[0]}: named twice. Name each recording once.")
    needs = _needed(effects) if len(data) > 1 else []
    return record_files.read(data, columns, needs, note=lambda words: print(words, file=sys.stderr))


def _needed(effects: Sequence[str]) -> list[str]:
    """The columns that effects need; of an unknown one the fit says so."""
    from stimrig.identify import effects as library

    found: list[str] = []
    for effect in effects:
        with contextlib.suppress(identify.IdentifyError):
            found += library.find_effect(effect.partition(":")[0]).needs
    return list(dict.fromkeys(found))


def short(data: Sequence[Path]) -> str:
    """Files at the head of a report."""
    return ", ".join(path.name for path in data)


def called(data: Sequence[Path]) -> str:
    """Files in a sentence."""
    return " and ".join(str(path) for path in data) if len(data) < 3 else f"{len(data)} recordings, {data[0]} first"


def load_held(path: Path | None, data: Sequence[Path], columns: list[str] | None = None) -> tuple[Any, Any, list[str]]:
    """A record, of one file or of several; the model whose structure is meant on it (none: the plain one); the effects
    that this holds.

    Raises InputError: as `load_model`; the model is one of another pulse rate, or one that effects do not stand on.
    """
    from stimrig.api.structure import held_by

    model = None if path is None else load_model(path)
    record = load_record(data, columns)
    try:
        return record, model, held_by(model, record)
    except identify.IdentifyError as error:
        raise InputError(f"{path}: {error}") from error


def write(path: Path, content: str | bytes) -> None:
    """Write a file. Raises InputError: it cannot be written."""
    with writing(path) as place:
        place.write_bytes(content.encode() if isinstance(content, str) else content)


def write_model(path: Path, model: Any) -> None:
    """Write a model: as MODEL.json, or where the name ends in .mat as a MAT file for other tools.

    Raises InputError: it cannot be written.
    """
    from stimrig.api.cli.result_files import write_model

    with writing(path) as place:
        write_model(place, model)


def write_mat(path: Path, variables: dict[str, Any]) -> None:
    """Write variables as a MAT file. Raises InputError: it cannot be written."""
    from stimrig.identify import plain_mat

    with writing(path) as place:
        plain_mat.write(place, variables)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A place to write a file at, which is whole or as it was; one line where it cannot. Raises InputError."""
    try:
        with whole_path(path) as place:
            yield place
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Give a file in a folder that can be written.") from error


def say_json(found: dict[str, Any]) -> None:
    """One JSON object, nothing else."""
    from stimrig.identify.json_text import json_value

    print(json.dumps(json_value(found), ensure_ascii=False, allow_nan=False))


def say(*lines: str) -> None:
    """Lines for people."""
    print("\n".join(lines))


def sign_in_lines(url: str, drawn: str | None, configured: bool, setting: str) -> list[str]:
    """How to get in: with the token that was drawn just now, the one in the setting, or one from before."""
    if drawn:
        return [f"first administrator's token, shown this once: {drawn}", f"sign in: {url}/sign-in#token={drawn}"]
    if configured:
        return [f"the administrator's token is the one in {setting}"]
    return [f"sign in with a token issued before (set {setting} to replace a lost one)"]


def number(value: float | None, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """A best-fit % for people; why there is none."""
    from stimrig.api.models.stored_model import UNDEFINED

    return UNDEFINED if value is None or not math.isfinite(value) else f"{value:.2f} %"


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Columns, aligned."""
    cells = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[index]) for row in cells) for index in range(len(cells[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]


def carried_lines(found: Mapping[str, Any] | None) -> list[str]:
    """What a record said of the structure of an earlier model; nothing where none was carried over."""
    if not found:
        return []
    needed = {True: "still needed", False: "no longer needed", None: "left out, undecided"}
    earlier = found.get("from_model_id") or found["carried_from"]
    lines = [
        f"from model {earlier}; offered: the {found['offered']} structure",
        found["reason"],
        *(f"{needed[row['needed']]}: {row['effect']}. {row['reason']}" for row in found["effects"]),
    ]
    return [f"{'' if number else 'carried over':15}{line}" for number, line in enumerate(lines)]


def repetition_lines(fit: Mapping[str, Any]) -> list[str]:
    """What repeats in the record, a line for each sentence."""
    from stimrig.identify.yardstick import repetition_sentences

    return [f"{'' if number else 'repetition':15}{line}" for number, line in enumerate(repetition_sentences(fit))]


def model_report(document: dict[str, Any]) -> list[str]:
    """What a person reads off a model."""
    from stimrig.api.models import stored_model
    from stimrig.identify.summary import one_line

    fit, judged = stored_model.figures(document), stored_model.quality(document)
    dynamics, curve = stored_model.dynamics(document), stored_model.recruitment(document)
    effects = ", ".join(effect["id"] for effect in document.get("effects") or []) or "none"
    in_turn = "in turn, cross-validated: " if fit["held_out_by"] == "cross-validation" else ""
    lines = [
        f"model          {document['model_id']}  ({document['method']}, effects: {effects})",
        f"fit            {percent(fit['fit_percent'])}  (the noise allows {number(fit['ceiling_percent'])} %), "
        f"error {number(fit['rms_nm'], 4)} N·m, noise {number(fit['noise_sd_nm'], 4)} N·m",
        "held out       nothing"
        if fit["held_out_rms_nm"] is None
        else f"held out       {in_turn}fit {percent(fit['held_out_fit_percent'])}, "
        f"error {number(fit['held_out_rms_nm'], 4)} N·m",
        *repetition_lines(document.get("fit") or {}),
    ]
    if dynamics["time_constant_s"] is not None:
        lines.append(
            f"dynamics       Tω {number(dynamics['time_constant_s'], 4)} s, ζ {number(dynamics['damping'], 4)}, "
            f"delay {number(1000 * (dynamics['delay_s'] or 0), 1)} ms"
        )
    elif dynamics["poles_per_s"]:
        lines.append(
            "dynamics       poles " + ", ".join(f"{re:+.3f}{im:+.3f}j" for re, im in dynamics["poles_per_s"]) + " 1/s"
        )
    lines.append(
        f"recruitment    threshold {number(curve['threshold_us'], 0)} µs (5 % of the rise), "
        f"plateau {number(curve['plateau_nm'])} N·m (95 % at {number(curve['saturation_us'], 0)} µs)"
    )
    chosen = (document.get("reasons") or [])[1:]
    lines += [f"{'' if number else 'chosen':15}{one_line(reason)}" for number, reason in enumerate(chosen)]
    lines.append(f"quality        {judged['verdict']}: {judged['words']}")
    return [*lines, *(f"               also: {reason}" for reason in judged["reasons"][1:])]
