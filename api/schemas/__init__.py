"""JSON Schemas of MODEL.json and of what each verb's `--json` prints, one file each; `$id` ends in its version.

A reader that knows 1.0 can read every 1.x: what comes is added, and nothing changes its meaning.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in FOLDER.glob("*.json")))
OF_VERB = {
    "fit": "model",
    "predict": "prediction",
    "compare": "comparison",
    "diagnose": "diagnosis",
    "improve": "improvement",
    "invert": "inversion",
}
"""The schema of a verb's `--json`, where it bears another name than the verb."""


def load(name: str) -> dict[str, Any]:
    """A schema by its name, or by the verb that prints it. Raises KeyError where there is none."""
    name = OF_VERB.get(name, name)
    if name not in NAMES:
        raise KeyError(name)
    return json.loads((FOLDER / f"{name}.json").read_text("utf-8"))


def component(name: str) -> dict[str, Any]:
    """A schema as a component of the OpenAPI document: references lead to its place there."""
    text = json.dumps({key: value for key, value in load(name).items() if key not in ("$schema", "$id")})
    return json.loads(text.replace('"#/$defs/', f'"#/components/schemas/{component_name(name)}/$defs/'))


def component_name(name: str) -> str:
    """What the OpenAPI document calls it."""
    return f"{name.title()}Json"
