"""Pages of the reference that are made from the code: names to import, routes, verbs. Called by conf.py."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import tempfile
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from stimrig import identify

MODULES = ("stimrig", "stimrig.cohort", "stimrig.effects", "stimrig.errors")


def rooms() -> list[str]:
    """`stimrig.identify` and its packages."""
    return [
        "stimrig.identify",
        *(f"stimrig.identify.{found.name}" for found in pkgutil.iter_modules(identify.__path__) if found.ispkg),
    ]


def names_of(module: ModuleType) -> list[str]:
    """What a module offers: its `__all__`, else what is defined in it without an underscore."""
    defined = (name for name, one in vars(module).items() if getattr(one, "__module__", "") == module.__name__)
    return [name for name in getattr(module, "__all__", [*defined]) if not name.startswith("_")]


@cache
def public() -> dict[str, Any]:
    """Every public function and class by the name under which it is imported, each once."""
    found: dict[str, Any] = {}
    for place in (*MODULES, *rooms()):
        module = importlib.import_module(place)
        for name in names_of(module):
            one = inspect.getattr_static(module, name, None) if place == "stimrig.effects" else getattr(module, name)
            ours = str(getattr(one, "__module__", "")).startswith("stimrig") and (
                inspect.isfunction(one) or inspect.isclass(one)
            )
            if ours and not any(one is other for other in found.values()):
                found[f"{place}.{name}"] = one
    return found


def members(one: type) -> dict[str, Any]:
    """Public methods and properties of a class, those that it inherits from ours included."""
    found: dict[str, Any] = {}
    for parent in reversed([parent for parent in one.__mro__ if parent.__module__.startswith("stimrig")]):
        for name, value in vars(parent).items():
            bare = getattr(value, "__func__", getattr(value, "func", value))
            if not name.startswith("_") and (inspect.isfunction(bare) or isinstance(value, property)):
                found[name] = bare
    return found


def fields(one: type) -> dict[str, str]:
    """The public fields of a class, each with what stands beside it: a comment, or a text below."""
    told: dict[str, str] = {}
    for parent in reversed([parent for parent in one.__mro__ if parent.__module__.startswith("stimrig")]):
        source = textwrap.dedent(inspect.getsource(parent))
        lines, tree = source.splitlines(), ast.parse(source).body[0]
        assert isinstance(tree, ast.ClassDef)
        for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id[0] != "_":
                below = after.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
                comment = lines[(node.end_lineno or 0) - 1][node.end_col_offset :].partition("#")[2]
                told[node.target.id] = str(below.value) if below else comment.lstrip(":").strip()
    return told


def attributes(one: type) -> list[str]:
    """The fields of a class as a section of numpydoc's."""
    rows = [
        line
        for name, words in fields(one).items()
        for line in (name, *textwrap.indent(words or "…", "    ").splitlines())
    ]
    return ["", "Attributes", "----------", *rows, ""] if rows else []


@cache
def links() -> dict[str, str]:
    """Words of a Parameters section that become links."""
    return {name.rpartition(".")[2]: name for name, one in reversed(public().items()) if inspect.isclass(one)}


def directives(place: str) -> Iterator[str]:
    """The public names of a module, as autodoc takes them."""
    for name, one in public().items():
        if name.rpartition(".")[0] == place:
            kind = "function" if inspect.isfunction(one) else "exception" if issubclass(one, BaseException) else "class"
            yield f".. auto{kind}:: {name}"
            if inspect.isclass(one) and members(one):
                yield f"   :members: {', '.join(members(one))}"
            yield ""


def python(places: tuple[str, ...] = MODULES) -> str:
    """The reference of modules: a heading, its first words, its names."""
    parts = []
    for place in places:
        told = list(directives(place))
        words = str(importlib.import_module(place).__doc__).partition("\n\n")[0]
        if told:
            parts.append("\n".join([f"## {place}", "", words, "", "```{eval-rst}", *told, "```", ""]))
    return "\n".join(parts)


def python_identify() -> str:
    """The same of the packages of `identify`."""
    return python(tuple(rooms()))


def command_line() -> str:
    """Every verb with its arguments and options."""
    from click import Context
    from typer.main import get_command

    from stimrig.api.cli.main import build

    def told(name: str, command: Any) -> Iterator[str]:
        below = getattr(command, "commands", {})
        if below and not command.params:
            for word, one in below.items():
                yield from told(f"{name} {word}", one)
            return
        text = command.get_help(Context(command, info_name=name)).replace("```", "")
        yield f"## {name}\n\n```text\n{text}\n```\n"

    return "\n".join(
        part
        for name, command in sorted(get_command(build()).commands.items())
        for part in told(f"stimrig {name}", command)
    )


@cache
def document() -> dict[str, Any]:
    """The OpenAPI document of a service that is made for it in an empty folder."""
    from stimrig.api.settings import Settings
    from stimrig.api.web.app import create_app

    with tempfile.TemporaryDirectory() as folder:
        return create_app(Settings(data_dir=Path(folder), rig_file=None)).openapi()


def type_of(schema: dict[str, Any]) -> str:
    """A schema in a few words, with links to models."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if ways := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(dict.fromkeys(type_of(way) for way in ways))
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {type_of(schema.get('items', {}))}"
    kind = schema.get("type", "any")
    return kind if isinstance(kind, str) else " or ".join(kind)


def cell(words: Any) -> str:
    """A text for a cell of a table, as it stands."""
    return re.sub(r"\s+", " ", str(words or "")).replace("|", "\\|").replace("<", "&lt;")


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table of Markdown; nothing where it has no rows."""
    lines = [f"| {' | '.join(row)} |" for row in (head, tuple("---" for _ in head), *rows)]
    return "\n".join([*lines, "\n"]) if rows else ""


def rest_routes() -> str:
    """Every operation: what it does, its scope, what it takes, what it answers."""
    parts = []
    for path, methods in sorted(document()["paths"].items()):
        for method, found in methods.items():
            parts.append(f"## {method.upper()} {path}\n\n{found.get('description') or found.get('summary', '')}\n")
            given = [
                (f"`{p['name']}`", p["in"], type_of(p.get("schema", {})), cell(p.get("description")))
                for p in found.get("parameters", [])
            ]
            bodies = found.get("requestBody", {}).get("content", {}).items()
            given += [("body", kind, type_of(body.get("schema", {})), "") for kind, body in bodies]
            parts.append(table(("takes", "in", "type", "is"), given))
            answers = [
                (
                    code,
                    ", ".join(type_of(body.get("schema", {})) for body in one.get("content", {}).values()),
                    cell(one.get("description")),
                )
                for code, one in sorted(found["responses"].items())
            ]
            parts.append(table(("answer", "type", "is"), answers))
    return "\n".join(parts)


def rest_models() -> str:
    """Every model of the document with its keys."""
    parts = []
    for name, schema in sorted(document()["components"]["schemas"].items()):
        needed = schema.get("required", [])
        rows = [
            (f"`{key}`{'' if key in needed else ' (may be missing)'}", type_of(one), cell(one.get("description")))
            for key, one in schema.get("properties", {}).items()
        ]
        parts.append(f"### {name}\n\n{cell(schema.get('description'))}\n\n{table(('key', 'type', 'is'), rows)}")
    return "\n".join(parts)
