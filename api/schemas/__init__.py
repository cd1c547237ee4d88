"""JSON Schemas of MODEL.json and of what each verb's `--json` prints, one file each; `$id` ends in its version.

That of MODEL.json stands in `identify`, which reads models by it.
A reader that knows 1.0 can read every 1.x: what comes is added, and nothing changes its meaning.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from stimrig.identify import model_schema

FILES = {"model": model_schema.FILE} | {path.stem: path for path in Path(__file__).parent.glob("*.json")}
NAMES = tuple(sorted(FILES))
OF_VERB = {
    "fit": "model",
    "predict": "prediction",
    "compare": "comparison",
    "diagnose": "diagnosis",
    "improve": "improvement",
    "explain": "explanation",
    "invert": "inversion",
}
"""The schema of a verb's `--json`, where it bears another name than the verb."""


def load(name: str) -> dict[str, Any]:
    """Return a schema by its name, or by the verb that prints it. Raises KeyError: there is none.

    Parameters
    ----------
    name : str
        As "fit" or "model".
    """
    return json.loads(FILES[OF_VERB.get(name, name)].read_text("utf-8"))


def components(name: str) -> dict[str, Any]:
    """Return a schema and its definitions as components of the OpenAPI document, where client generators look for them.

    An enumeration whose values differ only in case becomes a plain string, as generators make one name of each value.
    """
    prefix, whole = component_name(name), load(name)
    text = json.dumps({key: value for key, value in whole.items() if key not in ("$schema", "$id")})
    schema = json.loads(
        re.sub(r'"#/\$defs/(\w+)"', lambda match: f'"#/components/schemas/{prefix}{_title(match[1])}"', text)
    )
    parts = schema.pop("$defs", {})
    documents = {prefix: schema} | {prefix + _title(name): part for name, part in parts.items()}
    _drop_ambiguous_enums(documents)
    return documents


def _drop_ambiguous_enums(node: Any) -> None:
    if isinstance(node, list):
        for value in node:
            _drop_ambiguous_enums(value)
    elif isinstance(node, dict):
        _drop_ambiguous_enums(list(node.values()))
        listed = node.get("enum")
        if isinstance(listed, list) and len({str(value).lower() for value in listed}) < len(listed):
            del node["enum"]
            node["type"] = "string"


def _title(name: str) -> str:
    return name.title().replace("_", "")


def component_name(name: str) -> str:
    """Return the name of the schema in the OpenAPI document."""
    return f"{name.title()}Json"
