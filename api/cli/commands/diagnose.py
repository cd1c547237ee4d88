"""`stimrig diagnose`: what is missing in a model's structure."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from stimrig import identify
from stimrig.api.cli.files import load_structure
from stimrig.api.cli.options import ColumnMap, HeldModel, Json, SeveralData
from stimrig.api.cli.terminal import report
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words


def diagnose(data: SeveralData, model_json: HeldModel = None, columns: ColumnMap = None, as_json: Json = False) -> None:
    """Name the effects missing in a model's structure, most probable first; or none; or structure that none explains.

    Takes 5 to 60 s; up to three minutes where structure is left, with several recordings, or on a busy computer.

    DATA decides: a model given with --model lends its structure, not its numbers.
    """
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        diagnosis = identify.diagnose(record, model, progress)
    words = f"The structure examined is {in_words(structure)}."
    commands = add_command(diagnosis, model_json) + test_command(diagnosis, model_json)
    if diagnosis.conclusion.kind == "nothing":
        writes = f"improve {begin_with(model_json)}" if model_json else "fit "
        commands = [f"`stimrig {writes}DATA -o NEW.json` writes this model."]
    report({"structure": structure, **diagnosis.to_dict()}, as_json, diagnosis, words, *commands)


def add_command(diagnosis: identify.Diagnosis, examined: Path | None) -> list[str]:
    """Name the command that adds what is missing, if anything is; `examined`: the model, None for the plain one."""
    them = "it" if len(diagnosis.add) == 1 else "them"
    explain = f"`stimrig explain {begin_with(examined)}DATA -o NEW.json` adds {them}, and shows how the error falls."
    return [explain] * bool(diagnosis.add)


def begin_with(model_json: Path | None) -> str:
    """Write the option that names a model, if there is one."""
    return f"--model {quote(str(model_json))} " if model_json else ""


def test_command(diagnosis: identify.Diagnosis, given: Path | None) -> list[str]:
    """Name the command that plays the next test, if there is one; it knows nothing of a `given` model."""
    plain = ", as the plain structure asks for it" if given else ""
    return [f"`stimrig test --decide DATA` plays the next test{plain}."] * bool(diagnosis.deciding_experiment)
