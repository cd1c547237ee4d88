"""Parts of the reference that are made from the code: names to import, routes, verbs. Called by conf.py."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import tempfile
import textwrap
from collections.abc import Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from stimrig import identify

MODULES = ("stimrig", "stimrig.cohort", "stimrig.effects", "stimrig.errors")
ROOMS = (
    "stimrig.identify",
    *(f"stimrig.identify.{m.name}" for m in pkgutil.iter_modules(identify.__path__) if m.ispkg),
)


@cache
def public() -> dict[str, Any]:
    """Every public function and class by the name under which it is imported, each once."""
    by_name: dict[str, Any] = {}
    for place in (*MODULES, *ROOMS):
        module = importlib.import_module(place)
        public_names = [name for name, member in vars(module).items() if getattr(member, "__module__", "") == place]
        for name in getattr(module, "__all__", public_names):
            member = getattr(module, name)
            member = identify.effects.library if member is importlib.import_module("stimrig.effects") else member
            ours = str(getattr(member, "__module__", "")).startswith("stimrig") and name[0] != "_"
            if ours and (inspect.isfunction(member) or inspect.isclass(member)) and member not in by_name.values():
                by_name[f"{place}.{name}"] = member
    return by_name


def family(cls: type) -> list[type]:
    """A class and those of ours that it is made of, the first one last."""
    return [parent for parent in reversed(cls.__mro__) if parent.__module__.startswith("stimrig")]


def members(cls: type) -> dict[str, Any]:
    """Public methods and properties of a class, inherited ones included."""
    by_name: dict[str, Any] = {}
    for name, value in (item for parent in family(cls) for item in vars(parent).items() if item[0][0] != "_"):
        bare = getattr(value, "__func__", value)
        if inspect.isfunction(bare) or isinstance(value, property | cached_property):
            by_name[name] = bare
    return by_name


def attributes(cls: type) -> list[str]:
    """The public fields of a class as a section of numpydoc's, with what stands beside each in the code."""
    sections: dict[str, list[str]] = {}
    for parent in family(cls):
        source = textwrap.dedent(inspect.getsource(parent))
        (tree,) = ast.parse(source).body
        assert isinstance(tree, ast.ClassDef)
        for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and (name := ast.unparse(node.target))[0] != "_":
                below = after.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
                comment = source.splitlines()[(node.end_lineno or 0) - 1].partition("  # ")[2]
                words = str(below.value) if below else comment
                sections[name] = [f"{name} : {ast.unparse(node.annotation)}", textwrap.indent(words, "    "), ""]
    rows = "\n".join(line for lines in sections.values() for line in lines).splitlines()
    return ["", "Attributes", "----------", *rows] if rows else []


@cache
def links() -> dict[str, str]:
    """Words of a Parameters section that become links."""
    return {name.rpartition(".")[2]: name for name, member in reversed(public().items()) if inspect.isclass(member)}


def python(places: tuple[str, ...] = MODULES) -> str:
    """The reference of modules: a heading, its first words, its names."""
    parts = []
    for place in places:
        lines = []
        for name, member in public().items():
            if name.rpartition(".")[0] == place:
                kind = "class" if inspect.isclass(member) else "function"
                kind = "exception" if inspect.isclass(member) and issubclass(member, Exception) else kind
                methods = members(member) if inspect.isclass(member) else {}
                lines += [f".. auto{kind}:: {name}", *([f"   :members: {', '.join(methods)}"] if methods else []), ""]
        words = str(importlib.import_module(place).__doc__).partition("\n\n")[0]
        parts += [f"## {place}", "", words, "", "```{eval-rst}", *lines, "```", ""] if lines else []
    return "\n".join(parts)


def python_identify() -> str:
    """The same of the packages of `identify`."""
    return python(ROOMS)


def command_line() -> str:
    """Every verb with its arguments and options."""
    from click import Context
    from typer.main import get_command

    from stimrig.api.cli.main import build

    def describe(name: str, command: Any) -> Iterator[str]:
        yield f"## {name}\n\n```text\n{command.get_help(Context(command, info_name=name))}\n```\n"
        for word, subcommand in sorted(getattr(command, "commands", {}).items()):
            yield from describe(f"{name} {word}", subcommand)

    return "\n".join(describe("stimrig", get_command(build())))


@cache
def document() -> dict[str, Any]:
    """The OpenAPI document of a service in an empty folder."""
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
    return f"list of {type_of(schema['items'])}" if "items" in schema else str(schema.get("type", "any"))


def cell(words: str) -> str:
    """A text for a cell of a table."""
    return re.sub(r"\s+", " ", words).replace("|", r"\|").replace("<", "&lt;")


def table(head: str, rows: list[tuple[str, dict[str, Any], str]]) -> str:
    """A table of names with their type and meaning; nothing where there are none."""
    lines = [f"| {name} | {type_of(schema)} | {cell(words)} |" for name, schema, words in rows]
    return "\n".join([f"| {head} | type | is |", "|---|---|---|", *lines, "\n"]) if rows else ""


def rest_routes() -> str:
    """Every operation: what it does, its scope, what it takes, what it answers."""
    parts = []
    for path, methods in sorted(document()["paths"].items()):
        for method, operation in methods.items():
            bodies = operation.get("requestBody", {}).get("content", {}).items()
            rows = [
                (f"`{p['name']}` ({p['in']})", p["schema"], p.get("description", ""))
                for p in operation.get("parameters", [])
            ]
            rows += [(f"body ({kind})", body.get("schema", {}), "") for kind, body in bodies]
            done = [
                (f"{code} {kind}", body.get("schema", {}), response["description"])
                for code, response in operation["responses"].items() if code < "4"
                for kind, body in (response.get("content") or {"": {"schema": {"type": "nothing"}}}).items()
            ]  # fmt: skip
            refused = ", ".join(sorted(code for code in operation["responses"] if code >= "4"))
            description = operation.get("description") or operation.get("summary", "")
            parts += [f"## {method.upper()} {path}", description, table("takes", rows), table("answers", done)]
            parts += [f"Refusals: {refused}."] if refused else []
    return "\n\n".join(parts)


def rest_models() -> str:
    """Every model of the document with its keys."""
    parts = []
    for name, schema in sorted(document()["components"]["schemas"].items()):
        needed = schema.get("required", [])
        keys = schema.get("properties", {}).items()
        rows = [
            (f"`{key}`{'' if key in needed else ' (optional)'}", value, value.get("description", ""))
            for key, value in keys
        ]
        parts += [f"### {name}", schema.get("description", ""), table("key", rows)]
    return "\n\n".join(parts)
