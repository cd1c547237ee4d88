"""The reference: docstrings of everything public. `make docs` builds the site and takes a warning as an error."""

from __future__ import annotations

import importlib.util
import inspect
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from numpydoc.docscrape import FunctionDoc

ROOT = Path(__file__).parents[1]


@cache
def generators() -> ModuleType:
    """Import docs/generators.py, which no package holds."""
    spec = importlib.util.spec_from_file_location("generators", ROOT / "docs" / "generators.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lacking(name: str, one: Any) -> str:
    """Say what the docstring of a function, a property or a class lacks; empty: nothing.

    What is returned, the annotation says; of a method, its signature and a sentence say the rest.
    """
    if not inspect.getdoc(one) or (inspect.isclass(one) and str(one.__doc__).startswith(f"{one.__name__}(")):
        return f"{name}: no docstring"
    if not inspect.isfunction(one) or "." in one.__qualname__:
        return ""
    doc, signature = FunctionDoc(one), inspect.signature(one)
    documented = {part.strip().lstrip("*") for row in doc["Parameters"] for part in row.name.split(",")}
    parameters = set(signature.parameters) - {"self", "cls"}
    parts = [f"Parameters of {word}" for word in sorted(parameters ^ documented)]
    return f"{name}: {', '.join(parts)}" if parts else ""


def test_everything_public_has_a_docstring_with_its_sections() -> None:
    made, names = generators(), {}
    for name, one in made.public().items():
        names[name] = one
        if inspect.isclass(one):
            names |= {f"{name}.{word}": method for word, method in made.members(one).items()}
    assert {"stimrig.fit", "stimrig.Client.stop", "stimrig.effects", "stimrig.cohort.fit"} <= set(names)
    assert [lack for name, one in names.items() if (lack := lacking(name, one))] == []


def test_each_field_of_a_public_class_is_explained() -> None:
    made, bare = generators(), []
    for name, one in made.public().items():
        rows = made.attributes(one)[3:] if inspect.isclass(one) else []
        for row, below in pairwise([*rows, ""]):
            if row and row[0] != " " and not below.startswith("    "):
                bare.append(f"{name}: {row}")
    assert bare == []
