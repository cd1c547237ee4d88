"""Results as files and as reports: what verbs write with -o and --html, and programs with `stimrig.save`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stimrig import identify
from stimrig.api.structure import held_by, in_words
from stimrig.api.whole_file import whole_path
from stimrig.identify.inversion import Inversion


def save(what: Any, path: str | Path, record: identify.Record | None = None) -> Path:
    """Write a result to a file; the end of its name says how.

    Parameters
    ----------
    what : Model, Record, Inversion or Explanation
        A model: MODEL.json, `.mat` for other tools, or `.html`, a report beside its record. A record: `.csv` (joined
        ones, too), `.mat` or `.parquet`, as `read` takes them. An inversion: `.csv`, as `stimrig invert -o`. An
        explanation: `.html`.
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
    from stimrig.api.models import inverted

    path = Path(path)
    kind = path.suffix.lower()
    with whole_path(path) as place:
        if kind == ".html":
            place.write_text(report(what, record, path.stem), "utf-8", newline="")
        elif isinstance(what, identify.Model) and kind in (".json", ".mat"):
            write_model(place, what)
        elif isinstance(what, identify.Record) and kind[1:] in WRITERS:
            write_record(what, place, kind[1:])
        elif isinstance(what, Inversion) and kind == ".csv":
            place.write_text(inverted.table(what.to_dict()), "utf-8", newline="")
        else:
            fix = "A model is .json, .mat or .html, an explanation .html, a record .csv, .mat or .parquet, an "
            fix += "inversion .csv."
            raise identify.BadRequest(f"no {kind or 'such'} file of a {type(what).__name__}", place=str(path), fix=fix)
    return path


def write_model(path: Path, model: identify.Model) -> None:
    """As MODEL.json, or where the name ends in .mat as a MAT file for other tools. Raises OSError."""
    from stimrig.identify import plain_mat

    if path.suffix.lower() == ".mat":
        plain_mat.write(path, model.to_dict())
    else:
        path.write_text(model.to_json(), "utf-8", newline="")


def report(what: Any, record: identify.Record | None, name: str, found: identify.Comparison | None = None) -> str:
    """A model or an explanation beside its record, as one HTML file that works offline; `found`: compared already."""
    from stimrig.api.jobs.curves import curves, rounded
    from stimrig.api.web.pages.report_file import comparison_html
    from stimrig.identify.json_text import json_value

    if record is not None and isinstance(what, identify.Explanation):
        return story_page(told(record, what, held_by(what.improvement.models[0], record)), name)
    if record is not None and isinstance(what, identify.Model):
        compared = rounded((found or identify.compare(what, record)).to_dict())
        return comparison_html(what.to_dict(), json_value(curves(what, record)), name, comparison=compared)
    fix = "save(model, 'report.html', record); of what `explain` gives, too."
    raise identify.BadRequest("a report is of a model or an explanation, beside its record", place=name, fix=fix)


def told(record: Any, explained: Any, structure: Sequence[str]) -> dict[str, Any]:
    """The story of a record, and what its figures are drawn from."""
    from stimrig.api.jobs.curves import curves, rounded
    from stimrig.api.jobs.verbs import with_experiment
    from stimrig.api.models.explanation import step_versions
    from stimrig.api.models.story import story
    from stimrig.identify.conclusion import only_open

    models = explained.improvement.models
    pairs = zip((models[0], models[-1]), (explained.before, explained.after), strict=True)
    found = [{"curves": curves(one, record), "comparison": rounded(compared.to_dict())} for one, compared in pairs]
    before, after = found if len(models) > 1 else (found[0], found[0])
    held = held_by(models[-1], record)
    diagnoses = (with_experiment(record, explained.diagnosis, structure), with_experiment(record, explained.left, held))
    improvement, left_open = explained.improvement.to_dict(), only_open(vars(explained.left)) or {}
    # of what is left open the last diagnosis speaks
    improvement["refused"] = [row for row in improvement["refused"] if row["effect"] != left_open.get("effect")]
    made = story(step_versions(improvement), before["comparison"], after["comparison"], *diagnoses)
    return {"story": made, "before": before, "after": after, "improvement": improvement,
            "structure": in_words(structure)}  # fmt: skip


def story_page(shown: dict[str, Any], name: str) -> str:
    """The story as a file."""
    from stimrig.api.web.pages.report_file import story_html

    refused = shown["improvement"]["refused"]
    return story_html(shown["story"], shown["before"], shown["after"], name, refused, shown["structure"])
