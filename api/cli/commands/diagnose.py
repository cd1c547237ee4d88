"""`stimrig diagnose`: what is missing in a model's structure."""

from __future__ import annotations

from stimrig import identify
from stimrig.api.cli.files import load_structure
from stimrig.api.cli.options import ColumnMap, HeldModel, Json, SeveralData
from stimrig.api.cli.terminal import report
from stimrig.api.progress_bar import progress_bar
from stimrig.api.structure import in_words


def diagnose(data: SeveralData, model_json: HeldModel = None, columns: ColumnMap = None, as_json: Json = False) -> None:
    """Name the effects missing in a model's structure, most probable first; or none; or structure that none explains.

    Takes 5 to 30 s, longer where structure is left or with several recordings. DATA decides: a model given with --model
    lends its structure, not its numbers.
    """
    record, model, structure = load_structure(model_json, data, columns)
    with progress_bar() as progress:
        diagnosis = identify.diagnose(record, model, progress)
    words = f"The structure examined is {in_words(structure)}."
    report({"structure": structure, **diagnosis.to_dict()}, as_json, diagnosis, words, *next_commands(diagnosis))


def next_commands(diagnosis: identify.Diagnosis) -> list[str]:
    """Name the commands that do what is advised."""
    if diagnosis.conclusion.kind == "nothing":
        return ["`stimrig fit DATA -o MODEL.json` writes this model."]
    add = ["`stimrig explain DATA -o MODEL.json` adds it, and shows how the error falls."] if diagnosis.add else []
    return add + ["`stimrig test --decide DATA` plays the next test."] * bool(diagnosis.deciding_experiment)
