"""`stimrig schema`: the JSON Schema of MODEL.json, or of what a verb prints with `--json`."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from stimrig.api import schemas
from stimrig.api.cli.errors import InputError
from stimrig.api.cli.terminal import print_lines


def schema(
    name: Annotated[
        str | None, typer.Argument(help="a schema's name, or a verb; default: list all", metavar="NAME")
    ] = None,
) -> None:
    """Print a JSON Schema; its `$id` ends in its version."""
    if name is None:
        print_lines(*[schemas.load(known)["$id"] for known in schemas.NAMES])
        return
    try:
        print_lines(json.dumps(schemas.load(name), indent=2, ensure_ascii=False))
    except KeyError:
        raise InputError(f"{name}: no such schema. Give one of {', '.join(schemas.NAMES)}.") from None
