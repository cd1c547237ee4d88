"""Read the files that verbs are given; write what they make with -o and --html, and programs with `stimrig.save`."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.structure import held_by, in_words
from stimrig.api.whole_file import whole_path

LARGEST_MODEL_BYTES = 32 * 2**20


def load_model(path: Path) -> identify.Model:
    """Read a model. Raises OSError; InputError: the file holds no model."""
    with path.open("rb") as file:
        text = file.read(LARGEST_MODEL_BYTES)
    try:
        return identify.Model.from_json(text)
    except identify.IdentifyError as error:
        raise InputError(f"{path}: {error}") from error


def load_record(data: Sequence[Path], columns: list[str] | None = None, effects: Sequence[str] = ()) -> Any:
    """Read a record from its file, or from several as one; what was assumed goes to standard error.

    Raises IdentifyError: one cannot be read, they do not go together, or one lacks what one of the `effects` needs.
    """
    from stimrig.api import record_files
    from stimrig.identify import effects as library

    needs: dict[str, None] = {}
    for effect in effects if len(data) > 1 else ():
        with contextlib.suppress(identify.IdentifyError):  # of an unknown one the fit says so
            needs |= dict.fromkeys(library.find_effect(effect.partition(":")[0]).needs)
    return record_files.read(data, columns, [*needs], note=lambda words: print(words, file=sys.stderr))


def load_structure(path: Path | None, data: Sequence[Path], columns: list[str] | None) -> tuple[Any, Any, list[str]]:
    """Read a record, the model whose structure is meant on it (none: the plain one), and the effects of that.

    Raises InputError: as `load_model`; the model is one of another pulse rate, or one that effects do not stand on.
    """
    model = None if path is None else load_model(path)
    record = load_record(data, columns)
    try:
        return record, model, held_by(model, record)
    except identify.IdentifyError as error:
        raise InputError(f"{path}: {error}") from error


def check_outputs(
    inputs: Iterable[Path | None], *outputs: Path | None, data_dir: Path | None = None, new_folder: Path | None = None
) -> None:
    """Check before a verb computes that its outputs can be written, and that none replaces a file that it reads.

    Nor may one replace a file in `data_dir`, the service's data folder. Devices and pipes are always written.
    `new_folder`: the folder that the verb makes before it writes.

    Raises InputError.
    """
    made = new_folder and Path(os.path.realpath(new_folder))
    known = {Path(os.path.realpath(path)) for path in inputs if path is not None}
    for path in filter(None, outputs):
        if path.exists() and not path.is_file() and not path.is_dir() and os.access(path, os.W_OK):
            continue
        place = Path(os.path.realpath(path))
        if place in known:
            raise InputError(f"{path}: it would replace a file of this command. Give another name.")
        if data_dir is not None and place.is_file() and place.is_relative_to(os.path.realpath(data_dir)):
            raise InputError(f"{path}: it would replace a file of the data folder. Give another name.")
        folder = place.parent
        if made == folder:
            folder = next(each for each in (made, *made.parents) if each.exists())
        writable = folder.is_dir() and os.access(place if place.exists() else folder, os.W_OK)
        if place.is_dir() or not writable:
            raise InputError(f"{path}: give a file in a folder that can be written.")
        known.add(place)


def make_folder(folder: Path) -> None:
    """Make a `new_folder` of `check_outputs`; where a link leads to it, what the link names."""
    Path(os.path.realpath(folder)).mkdir(parents=True, exist_ok=True)


def short(data: Sequence[Path]) -> str:
    """Name files at the head of a report."""
    return ", ".join(path.name for path in data)


def write(path: Path | None, content: str | bytes | identify.Model) -> None:
    """Write a file, if one is asked for: a text, or a model as MODEL.json."""
    if path is None:
        return
    with whole_path(path) as place:
        if not isinstance(content, identify.Model):
            place.write_bytes(content.encode() if isinstance(content, str) else content)
        else:
            place.write_text(content.to_json(), "utf-8", newline="")


def save(what: Any, path: str | Path, record: identify.Record | None = None) -> Path:
    """Write a result to a file; the end of its name says how.

    Parameters
    ----------
    what : Model, Record, Inversion or Explanation
        A model: MODEL.json, or `.html`, a report beside its record. A record: `.csv` (joined ones, too), `.mat` or
        `.parquet`, as `read` takes them. An inversion: `.csv`, as `stimrig invert -o`. An explanation: `.html`.
    path : str or Path
        The file; one that is there is replaced.
    record : Record, optional
        The measurement that a report shows.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    BadRequest
        There is no such file of this result, or a report without its record.
    OSError
        It cannot be written.
    """
    from stimrig.api.export.record_file import WRITERS, write_record
    from stimrig.identify.inversion import Inversion

    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".html":
        write(path, html_report(what, record, path.stem))
    elif isinstance(what, identify.Model) and kind == ".json":
        write(path, what)
    elif isinstance(what, identify.Record) and kind[1:] in WRITERS:
        with whole_path(path) as place:
            write_record(what, place, kind[1:])
    elif isinstance(what, Inversion) and kind == ".csv":
        write(path, inversion_table(what.to_dict()))
    else:
        fix = "A model is .json or .html, an explanation .html, a record .csv, .mat or .parquet, an inversion .csv."
        raise identify.BadRequest(f"no {kind or 'such'} file of a {type(what).__name__}", place=str(path), fix=fix)
    return path


def inversion_table(inversion: dict[str, Any]) -> str:
    """Write pulse widths for a reference torque as a CSV table, a row for each pulse."""
    names = ("pulse_width_us", "reference_torque_nm", "predicted_torque_nm")
    rows = zip(*(inversion[name] for name in names), strict=True)
    lines = [
        f"{k / inversion['pulse_rate_hz']:.6g}," + ",".join(f"{each:g}" for each in row) for k, row in enumerate(rows)
    ]
    return "\r\n".join([",".join(["time_s", *names]), *lines, ""])


def html_report(what: Any, record: identify.Record | None, name: str) -> str:
    """Write a model or an explanation beside its record as one HTML file that works offline."""
    from stimrig.api.jobs.curves import curves, rounded
    from stimrig.api.web.pages.report_file import comparison_html, story_html
    from stimrig.identify.json_text import json_value

    if record is not None and isinstance(what, identify.Explanation):
        narrative = story_of(record, what)
        structure = in_words(held_by(what.improvement.models[0], record))
        return story_html(narrative["story"], narrative["before"], narrative["after"], name, structure)
    if record is not None and isinstance(what, identify.Model):
        comparison = rounded(identify.compare(what, record).to_dict())
        return comparison_html(what.to_dict(), json_value(curves(what, record)), name, comparison=comparison)
    fix = "save(model, 'report.html', record); of what `explain` gives, too."
    raise identify.BadRequest("a report is of a model or an explanation, beside its record", place=name, fix=fix)


def story_of(record: Any, explained: Any) -> dict[str, Any]:
    """Return the `story` of a record, and what its figures show (`before`, `after`)."""
    from stimrig.api.jobs.curves import curves, rounded
    from stimrig.api.jobs.verbs import with_experiment
    from stimrig.api.models.explanation import step_versions
    from stimrig.api.models.story import story

    models = explained.improvement.models
    before, after = (
        {"curves": curves(model, record), "comparison": rounded(compared.to_dict())}
        for model, compared in ((models[0], explained.before), (models[-1], explained.after))
    )
    after = after if len(models) > 1 else before
    diagnoses = (
        with_experiment(record, diagnosis, held_by(model, record))
        for model, diagnosis in ((models[0], explained.diagnosis), (models[-1], explained.left))
    )
    rows = step_versions(explained.improvement.to_dict())
    return {
        "story": story(rows, before["comparison"], after["comparison"], *diagnoses),
        "before": before,
        "after": after,
    }
