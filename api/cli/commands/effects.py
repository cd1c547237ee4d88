"""`stimrig effects`: the library of effects; a free effect of a model as a file of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import load_model
from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import report


def effects(
    export: Annotated[
        Path | None, typer.Option(help="write a free effect of this model as a file of one's own", metavar="MODEL.json")
    ] = None,
    effect: Annotated[str | None, typer.Option(help="the free effect; default: the model's last", metavar="ID")] = None,
    name: Annotated[str, typer.Option(help="how your effect is called", metavar="NAME")] = "my_effect",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the file; default: NAME.py")] = None,
    as_json: Json = False,
) -> None:
    """The library of effects: equation, parameters, source, signature, what each is confused with.

    With --export, what a free effect of a model was found to be is written as an effect that you edit and name.
    """
    from stimrig.identify.effects import library

    if export is None:
        entries = library()
        report({"effects": entries}, as_json, *("\n".join([*effect_lines(entry), ""]) for entry in entries))
        return
    text, path = own_text(export, effect, name), output or Path(f"{name}.py")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("x", encoding="utf-8") as file:
        file.write(text)
    report({"written": str(path)}, as_json, f"{path}: edit it, then set STIMRIG_EFFECTS_DIR to its folder")


def own_text(path: Path, wanted: str | None, name: str) -> str:
    """Return the text of an effect's file.

    Raises InputError: the model has no such free effect, or the name is taken. BadEffect: the name is none.
    """
    from stimrig.identify.effects import known_form, own_file, registry

    if name in registry():
        raise InputError(f"--name {name}: an effect is called so already. Give another name.")
    free = [entry for entry in load_model(path).effects if "shape" in entry]
    matches = [entry for entry in free if wanted in (None, entry["id"])]
    known = known_form(matches[-1]) if matches else None
    if known is None or known[0].shape is None:
        names = ", ".join(str(entry["id"]) for entry in free) or "none"
        raise InputError(f"{path}: no free effect{f' {wanted!r}' if wanted else ''} in it. It has {names}.")
    estimates = matches[-1]["parameters"]
    try:
        rows = {p.name: estimates[p.name] for p in known[1].parameters}
        values = {p: (float(row["value"]), float(row["sd"])) for p, row in rows.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {known[0].id} lacks a value or an sd: {error}. Fit the record again.") from error
    return own_file.text_of(*known, values, name)


def effect_lines(entry: dict[str, Any]) -> list[str]:
    """Write one effect for people."""
    lines = [str(entry["id"])]
    for key, value in entry.items():
        if key == "parameters":
            lines += [f"  {row['name']}: {_facts(row)}" for row in value]
        elif key == "forms":
            lines += [f"  form           {form['name']}: {form['equation']}" for form in value]
        elif value and key != "id":
            text = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
            lines.append(f"  {key.replace('_', ' '):14} {text}")
    return lines


def _facts(row: dict[str, Any]) -> str:
    facts = {key: fact for key, fact in row.items() if key != "name" and fact is not None}
    return ", ".join(f"{key.replace('_', ' ')} {fact}" for key, fact in facts.items())
