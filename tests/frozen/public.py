"""What is public, by name: a list that is kept (`public.toml`), and what of this tree does not hold to it.

An item that ends in `!` must be given. A name or an item that is gone, one that must be given now and need not before,
and a new one that must be given break what somebody built on it. They are refused, unless `stimrig.deprecations` told
of the name one minor version before; what is new is taken into the list by `python -m tests.frozen public`.
"""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import typer
from fastapi import FastAPI

from stimrig.deprecations import Deprecation

KEPT = Path(__file__).parent / "public.toml"
Public = dict[str, dict[str, list[str]]]
HEAD = "# What is public; made by `python -m tests.frozen public`, see docs/versions.md. `!`: must be given.\n"


def public() -> Public:
    """Of this tree: part, name, items."""
    return {
        "verbs": dict(_verbs()), "routes": dict(_routes()), "schemas": dict(_schemas()), "python": dict(_python()),
        "files": dict(_files()),
    }  # fmt: skip


def kept() -> Public:
    return tomllib.loads(KEPT.read_text("utf-8"))


def keep() -> None:
    """Write the list as this tree has it."""
    parts = [HEAD]
    for part, names in public().items():
        parts.append(f"\n[{part}]\n")
        for name, items in sorted(names.items()):
            parts.append(f"{json.dumps(name)} = {json.dumps(items, ensure_ascii=False)}\n")
    KEPT.write_text("".join(parts), "utf-8")


def broken(before: Public, now: Public, told: Sequence[Deprecation], version: str) -> list[str]:
    """A line for each incompatible change that nobody was told of in time."""
    gone = {one.name for one in told if _minor(one.since) < _minor(one.gone_in) <= _minor(version)}
    lines = []
    for part, names in before.items():
        for name, items in names.items():
            place = f"{part}/{name}"
            if place in gone:
                continue
            if name not in now.get(part, {}):
                lines.append(f"{place}: gone")
            else:
                lines += [
                    line for item, line in _changes(place, items, now[part][name]) if f"{place} {item}" not in gone
                ]
    return lines


def new(before: Public, now: Public) -> list[str]:
    """What the kept list has not."""
    flat = {
        part: {(name, item) for name, items in names.items() for item in ("", *items)} for part, names in now.items()
    }
    old = {
        part: {(name, item) for name, items in names.items() for item in ("", *items)} for part, names in before.items()
    }
    return [
        f"{part}/{name} {item}".rstrip() for part in flat for name, item in sorted(flat[part] - old.get(part, set()))
    ]


def unwarned(told: Sequence[Deprecation], version: str, before: Public) -> list[str]:
    """What the list of deprecations itself lacks: less than one minor version's notice, or a name nobody knows."""
    lines = []
    for one in told:
        part, _, name = one.name.partition("/")
        if _minor(one.gone_in) <= _minor(one.since):
            lines.append(f"{one.name}: gone in {one.gone_in} without a minor version's notice since {one.since}")
        if part not in before:
            lines.append(f"{one.name}: no such part")
        if part == "routes" and (one.since_on is None or one.gone_on is None):
            lines.append(f"{one.name}: a route's headers need since_on and gone_on")
        listed = {
            f"{known} {item.rstrip('!')}".rstrip()
            for known, items in before.get(part, {}).items()
            for item in ("", *items)
        }
        if _minor(one.gone_in) <= _minor(version) and name in listed:
            lines.append(f"{one.name}: gone by now, but still in the list; python -m tests.frozen public")
    return lines


def _changes(place: str, before: Iterable[str], now: Iterable[str]) -> Iterator[tuple[str, str]]:
    old, new_ = ({item.rstrip("!"): item.endswith("!") for item in items} for items in (before, now))
    for item, must in old.items():
        if item not in new_:
            yield item, f"{place}: {item} gone"
        elif new_[item] and not must:
            yield item, f"{place}: {item} must be given now"
    for item, must in new_.items():
        if must and item not in old and (": " not in item or item.partition(": ")[0] in old):
            yield item, f"{place}: {item} is new and must be given"


def _minor(version: str) -> tuple[int, int]:
    major, minor, *_ = [*(int(number) for number in re.findall(r"\d+", version)), 0, 0]
    return major, minor


def _item(name: str, must: bool) -> str:
    return f"{name}!" if must else name


# ---- the parts -----------------------------------------------------------------------------------------------------


def _verbs() -> Iterator[tuple[str, list[str]]]:
    from stimrig.api.cli.main import build

    yield from _commands(typer.main.get_command(build()), "")


def _commands(command: Any, name: str) -> Iterator[tuple[str, list[str]]]:
    inside = getattr(command, "commands", None)
    if inside is not None:
        for word, one in inside.items():
            yield from _commands(one, f"{name} {word}".strip())
        return
    items = []
    for one in command.params:
        is_argument = one.param_type_name == "argument"
        words = [str(one.name)] if is_argument else [*one.opts, *one.secondary_opts]
        items += [_item(word, one.required) for word in words]
    yield name, items


def _routes() -> Iterator[tuple[str, list[str]]]:
    from stimrig.api.centre import app as centre
    from stimrig.api.web import app as rig
    from stimrig.api.web import openapi

    of_centre = FastAPI(title="centre")
    for router in centre.ROUTERS:
        of_centre.include_router(router)
    for prefix, whole in (("", FastAPI(routes=list(rig._routes()))), ("centre ", of_centre)):
        whole.state.context = SimpleNamespace(auth=SimpleNamespace(cookie_name="cookie"))
        openapi.describe(whole)
        yield from _operations(whole.openapi(), prefix)


def _operations(document: dict[str, Any], prefix: str) -> Iterator[tuple[str, list[str]]]:
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            items = [_item(f"{one['in']}.{one['name']}", one["required"]) for one in operation.get("parameters", [])]
            body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema")
            items += [_item(f"body.{name}", must) for name, must in _properties(document, body)]
            for status, answer in sorted(operation["responses"].items()):
                content = answer.get("content", {}).get("application/json", {}).get("schema")
                items += [f"{status}.{name}" for name, _ in _properties(document, content) if status[0] == "2"]
            yield f"{prefix}{method.upper()} {path}", items


def _properties(document: dict[str, Any], schema: dict[str, Any] | None) -> list[tuple[str, bool]]:
    """Of an object, or of the objects of a list: its members' names, and whether they must be there."""
    found: Any = schema or {}
    named = document.get("components", {}).get("schemas", {})
    while "$ref" in found or "items" in found:
        found = found["items"] if "items" in found else named[found["$ref"].split("/")[-1]]
    parts = found.get("anyOf") or found.get("oneOf")
    if parts:
        return sorted({(name, False) for part in parts for name, _ in _properties(document, part)})
    return [(name, name in found.get("required", ())) for name in found.get("properties", {})]


def _schemas() -> Iterator[tuple[str, list[str]]]:
    from stimrig.api import schemas

    for name in schemas.NAMES:
        yield name, sorted(set(_paths(schemas.load(name), "")))


def _paths(schema: Any, place: str) -> Iterator[str]:
    """Of what is written: each key's place; those within lists by `[]`."""
    if not isinstance(schema, dict):
        return
    for name, inside in schema.get("properties", {}).items():
        yield f"{place}{name}"
        yield from _paths(inside, f"{place}{name}.")
    yield from _paths(schema.get("items"), f"{place}[].")
    for part in (*schema.get("anyOf", ()), *schema.get("oneOf", ()), *schema.get("allOf", ())):
        yield from _paths(part, place)


def _python() -> Iterator[tuple[str, list[str]]]:
    stimrig = importlib.import_module("stimrig")
    for name in stimrig.__all__:
        found = getattr(stimrig, name)
        if inspect.isclass(found):
            yield name, list(_members(found))
        elif inspect.ismodule(found) and not callable(found):
            yield name, sorted(getattr(found, "__all__", [one for one in vars(found) if one[0].isupper()]))
        else:
            yield name, _signature(found)


def _members(of: type) -> Iterator[str]:
    """Names, and of methods their parameters."""
    for name in sorted(name for name in dir(of) if not name.startswith("_")):
        yield name
        if inspect.isfunction(found := getattr(of, name)) or inspect.ismethod(found):
            yield from (f"{name}: {one}" for one in _signature(found))


def _signature(of: Any) -> list[str]:
    found = inspect.signature(cast(Any, type(of)).__call__ if inspect.ismodule(of) else of).parameters.values()
    must = inspect.Parameter.empty
    own = [one for one in found if one.name != "self" and one.kind.name not in ("VAR_POSITIONAL", "VAR_KEYWORD")]
    return [_item(one.name, one.default is must) for one in own]


def _files() -> Iterator[tuple[str, list[str]]]:
    """Keys of the rig file and names of the settings."""
    from stimrig.api.centre.context import CentreSettings
    from stimrig.api.settings import Settings
    from stimrig.rig import config, devices

    for model in (Settings, CentreSettings):
        prefix = str(model.model_config.get("env_prefix", ""))
        yield f"settings {prefix}", [f"{prefix}{name}".upper() for name in model.model_fields]
    rig = {"rig file": config.RigConfig, "rig file limits": config.LimitSettings, "rig file watch": config.Watch}
    for path in sorted(Path(devices.__path__[0]).glob("[a-z]*.py")):
        module = importlib.import_module(f"{devices.__name__}.{path.stem}")
        if hasattr(module, "Settings"):
            rig[f"rig file device {path.stem}"] = module.Settings
    for name, one in rig.items():
        yield name, [_item(key, field.is_required()) for key, field in one.model_fields.items()]


def main() -> int:
    """Write the list, and say what is new or broken."""
    version = tomllib.loads((KEPT.parents[2] / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    from stimrig.deprecations import DEPRECATIONS

    if KEPT.exists():
        lines = broken(kept(), public(), DEPRECATIONS, version)
        if lines:
            print("\n".join(lines), file=sys.stderr)
            print("not written: tell of it in stimrig/deprecations.py first (docs/versions.md)", file=sys.stderr)
            return 1
        print("\n".join(new(kept(), public())))
    keep()
    return 0
