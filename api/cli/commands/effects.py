"""`stimrig effects`: the library."""

from __future__ import annotations

from typing import Any

from stimrig.api.cli.terminal import Json, say, say_json


def effects(as_json: Json = False) -> None:
    """The library of effects: equation, parameters, source, signature, what each is confused with."""
    from stimrig.identify import effects as library

    found = library.library()
    if as_json:
        say_json({"effects": found})
        return
    for entry in found:
        say(*effect_lines(entry), "")


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
            shown = ", ".join(str(item) for item in value) if isinstance(value, list | tuple) else str(value)
            lines.append(f"  {key.replace('_', ' '):14} {shown}")
    return lines
