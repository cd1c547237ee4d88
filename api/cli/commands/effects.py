"""`stimrig effects`: the library."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from stimrig import identify
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.files import load_model
from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import say, say_json


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
    if export is not None:
        path = output or Path(f"{name}.py")
        _write(path, _own_text(export, effect, name))
        say_json({"written": str(path)}) if as_json else say(
            f"{path}: edit it, then set STIMRIG_EFFECTS_DIR to its folder"
        )
        return
    from stimrig.identify import effects as library

    entries = library.library()
    if as_json:
        say_json({"effects": entries})
        return
    for entry in entries:
        say(*effect_lines(entry), "")


def _own_text(path: Path, wanted: str | None, name: str) -> str:
    """Return the text of an effect's file.

    Raises InputError: the model has no such free effect, or the name is none or taken.
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
        values = {
            p.name: (float(estimates[p.name]["value"]), float(estimates[p.name]["sd"])) for p in known[1].parameters
        }
        return own_file.text_of(*known, values, name)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: {known[0].id} lacks a value or an sd: {error}. Fit the record again.") from error
    except identify.IdentifyError as error:
        raise InputError(str(error)) from error


def _write(path: Path, text: str) -> None:
    """A new file. Raises InputError: it is there, or cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}. Give another file with -o.") from error


def effect_lines(entry: dict[str, Any]) -> list[str]:
    """One effect for people."""
    lines = [str(entry["id"])]
    for key, value in entry.items():
        if key == "id" or not value:
            continue
        if key == "parameters":
            for parameter in value:
                facts = {name: fact for name, fact in parameter.items() if name != "name" and fact is not None}
                words = ", ".join(f"{name.replace('_', ' ')} {fact}" for name, fact in facts.items())
                lines.append(f"  {parameter['name']}: {words}")
        elif key == "forms":
            lines += [f"  {'form':14} {form['name']}: {form['equation']}" for form in value]
        else:
            text = ", ".join(str(item) for item in value) if isinstance(value, list | tuple) else str(value)
            lines.append(f"  {key.replace('_', ' '):14} {text}")
    return lines
