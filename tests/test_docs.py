"""The documentation says what is so: links, paths, names, commands, tables of settings, and quoted figures."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
import typer
from fastapi.routing import APIRoute

from stimrig import identify
from stimrig.api.centre.context import CentreSettings
from stimrig.api.cli.main import build
from stimrig.api.settings import Settings
from stimrig.api.web import routes
from stimrig.api.web.app import routers
from stimrig.identify.diagnosis import thresholds
from stimrig.identify.effects import registry
from stimrig.identify.estimation.samples import prepare
from stimrig.identify.paper import simulate
from stimrig.rig import sequences
from stimrig.rig.acquire.health import Watch
from stimrig.rig.config import LimitSettings
from stimrig.rig.limits import HARD_LIMITS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
FOLDERS = {path.name for path in ROOT.iterdir() if path.is_dir()} - {"var", "build", "dist"}  # of the repository
PACKAGES = ("rig", "identify", "api", "hardware_sim", "bench", "tests", "stimrig", "examples")
PARTS = {"rig", "identify", "api", "hardware_sim"}
LINK = re.compile(r"\]\(([^)\s]+)\)")
ENTRY_POINTS = "stimrig.effects"
QUOTE = re.compile(r"<!-- quote: ([^|]+?) \| (.+?) \| ([^|]+?) -->")


@cache
def text(page: Path) -> str:
    return page.read_text("utf-8")


def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text(page), flags=re.M | re.S)


def code(page: Path) -> list[str]:
    """What stands in backticks, and each line of the fenced blocks."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text(page), re.M | re.S)
    return re.findall(r"`([^`\n]+)`", prose(page)) + [line for block in blocks for line in block.splitlines()]


def table(page: Path, heading: str) -> list[list[str]]:
    """The cells of the first table under a heading, without its head and without backticks."""
    lines = text(page).partition(f"\n{heading}\n")[2].splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("|"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip().replace("`", "") for cell in line.strip("|").split("|")])
    assert rows, heading
    return rows


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as they are made of the headings' words."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text(page), flags=re.M | re.S), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(prose(page)):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_paths_and_names_in_backticks_exist(page: Path) -> None:
    for word in code(page):
        name = word.split("::")[0]
        if re.fullmatch(r"[\w.\-]+(/[\w.\-]+)*/?", name) and "/" in name and name.split("/")[0] in FOLDERS:
            assert (ROOT / name).exists(), word
        called = re.fullmatch(rf"(({'|'.join(PACKAGES)})(\.\w+)+)(\(.*\))?", word)
        if called and not re.search(r"\.(md|toml|py|json|log|env)$", word):
            assert called[2] not in PARTS, f"{word}: nobody can import it but as part of stimrig"
            assert resolves(called[1]), word


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or a name in one, or the group of entry points of effects."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(found, part):
                return name == ENTRY_POINTS
            found = getattr(found, part)
        return True
    return name == ENTRY_POINTS


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", text(ROOT / "Makefile"), re.M))
    for line in code(page):
        for target in re.findall(r"^(?:\$ )?make ([a-z][a-z-]*)", line):
            assert target in targets, line
        for module in re.findall(r"python -m ([\w.]+)", line):
            assert importlib.util.find_spec(module), line
        for path in re.findall(r"python ([\w/]+\.py)", line):
            assert (ROOT / path).exists(), line
        if line.startswith(("from ", "import ")):
            continue
        for words in re.findall(r"(?<![\w/.-])stimrig ([a-z][a-z0-9]+(?![\w:])[^|#;]*)", line):
            check_verb(words, line)


def check_verb(words: str, line: str) -> None:
    """The verb is there, and takes the options that are given to it."""
    command = typer.main.get_command(build())
    given = shlex.split(words.replace("'", ""))
    while given and hasattr(command, "commands"):
        if given[0].startswith("-"):
            return
        assert given[0] in command.commands, line
        command = command.commands[given.pop(0)]
    if command.name in ("emulate", "init"):  # their options are those of the process behind them
        return
    known = {option for parameter in command.params for option in parameter.opts} | {"--help", "-h"}
    options = {word.split("=")[0].strip("[]`.,") for word in given if re.match(r"\[?-\S+$", word)}
    assert options <= known, line


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_settings_of_the_environment_exist(page: Path) -> None:
    known = {f"STIMRIG_{field.upper()}" for field in Settings.model_fields}
    known |= {f"STIMRIG_CENTRE_{field.upper()}" for field in CentreSettings.model_fields}
    elsewhere = {
        "STIMRIG_CENTRE_URL",
        "STIMRIG_CENTRE_KEY",
        "STIMRIG_TOKEN",
        "STIMRIG_URL",
        "STIMRIG_EXAMPLES",
        "STIMRIG_SEED",
        "STIMRIG_SOAK_MINUTES",
    }
    assert set(re.findall(r"STIMRIG_[A-Z_]*[A-Z]", text(page))) <= known | elsewhere


def quotes() -> list[tuple[str, str, str, str]]:
    """Page, results file, words of its line, figure; the figure stands right before the mark."""
    return [(name, *found) for name, page in zip(NAMES, PAGES, strict=True) for found in QUOTE.findall(text(page))]


@pytest.mark.parametrize(("name", "file", "words", "figure"), quotes(), ids=[f"{q[0]}: {q[3]}" for q in quotes()])
def test_quoted_figures_stand_in_the_results(name: str, file: str, words: str, figure: str) -> None:
    exact = re.compile(rf"(?<![\d.]){re.escape(figure)}(?![\d]|\.\d)")
    assert any(words in line and exact.search(line) for line in text(DOCS / file).splitlines())
    before = text(ROOT / name).split(f"<!-- quote: {file} | {words} | {figure} -->")[0]
    paragraph = QUOTE.sub("", before.rsplit("\n\n", 1)[-1].rsplit("-->", 1)[-1])
    assert exact.search(paragraph), "the figure does not stand before its mark"


def test_figures_are_quoted_at_all() -> None:
    assert len(quotes()) > 10


@pytest.mark.parametrize("page", sorted((DOCS / "results").glob("*.md")), ids=lambda page: page.name)
def test_results_say_command_date_and_commit(page: Path) -> None:
    assert re.search(r"`(python|make|pytest|STIMRIG_\w+=\S+) ?[^`]*`|By hand", text(page))
    assert re.search(r"\d{4}-\d{2}-\d{2}", text(page))
    assert re.search(r"commit [0-9a-f]{7}", text(page))


def test_the_index_names_every_page() -> None:
    here = {p for p in DOCS.rglob("*.md") if p.name != "README.md" and p.parent.name not in ("decisions", "safety")}
    named = {(DOCS / link.split("#")[0]).resolve() for link in LINK.findall(text(DOCS / "README.md"))}
    assert here <= named
    decisions = {path.name for path in (DOCS / "decisions").glob("0*.md")}
    assert decisions == set(re.findall(r"\((0[^)]+)\)", text(DOCS / "decisions" / "README.md")))


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


def test_effects_for_clinicians() -> None:
    rows = table(DOCS / "clinicians.md", "## Effects, and what they mean for the session")
    written = {row[0].split()[-1]: not row[3].startswith("no") for row in rows}
    assert written == {effect: found.predictable for effect, found in registry().items()}


def test_words_of_the_page_for_clinicians() -> None:
    """What is set in italics as a word of the page is on the page."""
    shown = " ".join(
        text(path) for pattern in ("*.html", "*.py", "*.js") for path in sorted((ROOT / "api").rglob(pattern))
    )
    known = shown + " ".join(effect.name for effect in registry().values())
    words = re.findall(r"(?<!\*)\*([^*\n]+)\*(?!\*)", prose(DOCS / "clinicians.md"))
    assert len(words) > 10
    assert [word for word in words if word.lower() not in known.lower()] == []


def test_thresholds_of_the_diagnosis() -> None:
    for words, value, name in table(DOCS / "diagnosis.md", "### The thresholds"):
        assert getattr(thresholds, name) == float(value), words


def test_limits_and_watches_of_the_rig_file() -> None:
    limits = {row[0]: row[1] for row in table(DOCS / "rig-file.md", "## `[limits]`")}
    assert set(limits) == set(LimitSettings.model_fields)
    for name in set(limits) & set(HARD_LIMITS):
        at_least = limits[name].startswith("at least ")
        stated = float(limits[name].removeprefix("at least ").split(",")[0].split(" a ")[0].replace(" ", ""))
        assert stated == (HARD_LIMITS[name].lo if at_least else HARD_LIMITS[name].hi), name
    watches = {row[0]: row[1] for row in table(DOCS / "rig-file.md", "## `[watch]`")}
    assert watches == {name: f"{field.default:g}" for name, field in Watch.model_fields.items()}


def test_the_method_that_is_shown_works() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", text(DOCS / "methods.md"), re.M | re.S)
    scope: dict[str, object] = {}
    exec(compile(block, "methods.md", "exec"), scope)
    method = scope["METHOD"]
    assert isinstance(method, identify.methods.Method)
    record, _ = simulate(0.02, 1, 40.0)
    model = method.fit(prepare(record)[0], None, time_constant_s=0.374)
    assert model.fit["fit_percent"] > 80
    assert model.quality["verdict"] == "not usable"  # assumed dynamics do not do on unseen input
