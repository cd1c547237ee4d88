"""`stimrig effects`: the library of effects."""

from __future__ import annotations

from typing import Any

from stimrig.api.cli.options import Json
from stimrig.api.cli.terminal import report


def effects(as_json: Json = False) -> None:
    """The library of effects: equation, parameters, source, signature, what each is confused with."""
    from stimrig.identify.effects import library

    entries = library()
    report({"effects": entries}, as_json, *("\n".join([*effect_lines(entry), ""]) for entry in entries))


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
