"""The documentation agrees with the product: links, commands, routes, sequences, limits."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import typer
from fastapi.routing import APIRoute

from stimrig import identify
from stimrig.api.cli.main import build
from stimrig.api.web import routes
from stimrig.api.web.app import routers
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.paper import simulate
from stimrig.rig import sequences
from stimrig.rig.acquire.health import Watch
from stimrig.rig.config import LimitSettings
from stimrig.rig.limits import HARD_LIMITS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
LINK = re.compile(r"\]\(([^)\s]+)\)")
BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.M | re.S)


def prose(page: Path) -> str:
    """Return the page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)


def code(page: Path) -> list[str]:
    """Return what stands in backticks, and each line of the fenced blocks."""
    blocks = BLOCK.findall(page.read_text("utf-8"))
    return re.findall(r"`([^`\n]+)`", prose(page)) + [line for block in blocks for line in block.splitlines()]


def table(page: Path, heading: str) -> list[list[str]]:
    """Return the cells of the first table under a heading, without its head and without backticks."""
    lines = page.read_text("utf-8").partition(f"\n{heading}\n")[2].splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("|"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip().replace("`", "") for cell in line.strip("|").split("|")])
    assert rows, heading
    return rows


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_lead_somewhere() -> None:
    dead = []
    for page in PAGES:
        for link in (link for link in LINK.findall(prose(page)) if "://" not in link):
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            if not target.exists() or (anchor and anchor not in anchors(target)):
                dead.append(f"{page.relative_to(ROOT)}: {link}")
    assert dead == []


def test_commands_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    command = typer.main.get_command(build())
    for page in PAGES:
        for line in code(page):
            where = f"{page.relative_to(ROOT)}: {line}"
            assert set(re.findall(r"^(?:\$ )?make ([a-z][a-z-]*)", line)) <= targets, where
            assert all(importlib.util.find_spec(module) for module in re.findall(r"python -m ([\w.]+)", line)), where
            assert all((ROOT / path).exists() for path in re.findall(r"python ([\w/]+\.py)", line)), where
            if not line.startswith(("from ", "import ")):
                for words in re.findall(r"(?<![\w/.-])stimrig ([a-z][a-z0-9]+(?![\w:])[^|#;]*)", line):
                    check_verb(command, words, where)


def check_verb(command: typer.core.TyperGroup, words: str, where: str) -> None:
    """Assert that the verb is there, and takes the options that are given to it."""
    given = shlex.split(words.replace("'", ""))
    while given and hasattr(command, "commands"):
        if given[0].startswith("-"):
            return
        assert given[0] in command.commands, where
        command = command.commands[given.pop(0)]
    if command.name in ("emulate", "init"):  # their options are those of the process behind them
        return
    known = {option for parameter in command.params for option in parameter.opts} | {"--help", "-h"}
    options = {word.split("=")[0].strip("[]`.,") for word in given if re.match(r"\[?-\S+$", word)}
    assert options <= known, where


def test_the_table_of_routes_is_that_of_the_service() -> None:
    written = {re.sub(r"\{\w+\}", "{}", row[0]) for row in table(DOCS / "api.md", "## Routes")}
    there = {
        f"{method} {re.sub(r'{[a-z_]+}', '{}', route.path)}"
        for router in routers(routes)
        for route in router.routes
        if isinstance(route, APIRoute) and route.include_in_schema
        for method in route.methods
    }
    assert written - {"WS /v1/tests/{}/live"} == there


def test_sequences_and_their_settings() -> None:
    written = {(row[0], row[1]): row[2] for row in table(DOCS / "sequences.md", "## Settings")}
    there = {}
    for name, module in sequences.library().items():
        for setting, field in module.Settings.model_fields.items():
            default = "needed" if field.is_required() else str(field.default).lower()
            there[name, setting] = default
    assert written == there


def test_limits_and_watches_of_the_rig_file() -> None:
    limits = {row[0]: row[1] for row in table(DOCS / "rig-file.md", "## `[limits]`")}
    assert set(limits) == set(LimitSettings.model_fields)
    for name in set(limits) & set(HARD_LIMITS):
        at_least = limits[name].startswith("at least ")
        stated = float(limits[name].removeprefix("at least ").split(",")[0].split(" a ")[0].replace(" ", ""))
        assert stated == (HARD_LIMITS[name].lo if at_least else HARD_LIMITS[name].hi), name
    watches = {row[0]: row[1] for row in table(DOCS / "rig-file.md", "## `[watch]`")}
    assert watches == {name: f"{field.default:g}" for name, field in Watch.model_fields.items()}


@pytest.mark.slow
def test_the_method_that_is_shown_works() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", (DOCS / "methods.md").read_text("utf-8"), re.M | re.S)
    scope: dict[str, object] = {}
    exec(compile(block, "methods.md", "exec"), scope)
    method = scope["METHOD"]
    assert isinstance(method, identify.methods.Method)
    record, _ = simulate(0.02, 1, 40.0)
    model = method.fit(prepare(record)[0], None, time_constant_s=0.374)
    assert model.fit["fit_percent"] > 80
    assert model.quality["verdict"] == "not usable"  # assumed dynamics do not do on unseen input
