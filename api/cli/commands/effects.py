"""`stimrig effects`: the library."""

from __future__ import annotations

from typing import Any

from api.cli.terminal import Json, say, say_json


def effects(as_json: Json = False) -> None:
    """The library of effects: equation, parameters, source, signature, what each is confused with."""
    from identify import effects as library

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
            lines += [f"  {line}" for line in parameter_lines(value)]
        elif key == "forms":
            lines += [f"  {'form':14} {form['name']}: {form['equation']}" for form in value]
        else:
            shown = ", ".join(str(item) for item in value) if isinstance(value, list | tuple) else str(value)
            lines.append(f"  {key.replace('_', ' '):14} {shown}")
    return lines


def parameter_lines(parameters: Any) -> list[str]:
    """Parameters with units and ranges, however the library lists them."""
    items = parameters.items() if isinstance(parameters, dict) else [(item.get("name"), item) for item in parameters]
    lines = []
    for name, item in items:
        facts = ", ".join(
            f"{key.replace('_', ' ')} {value}" for key, value in item.items() if key != "name" and value is not None
        )
        lines.append(f"{name}: {facts}")
    return lines
