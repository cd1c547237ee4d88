"""The parts of the technical file that are made of tables: Markdown, by the name in their page's mark."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from deploy import soup
from deploy.technical_file import drawing, figures, sbom, traces
from deploy.technical_file.places import ROOT, Row, Tables


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table; a bar in a cell is not the end of it."""
    heads = list(head)
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(names: Iterable[str]) -> str:
    """Names of places and tests, each once, in order."""
    return "<br>".join(f"`{name}`" for name in dict.fromkeys(names))


def hazards(tables: Tables) -> str:
    """Hazard, causes, and of each control its requirement, places and tests."""
    blocks = []
    for hazard in tables["hazards"]["hazard"]:
        judged = f" Judged in simulated lives: {', '.join(hazard['invariants'])}." if hazard.get("invariants") else ""
        rows = [(c["what"], c["requirement"], code(c["where"]), code(c["tests"])) for c in hazard["control"]]
        blocks += [
            f"### {hazard['id']}: {hazard['title']}",
            f"**{hazard['severity'].capitalize()}.** Harm: {hazard['harm']}. "
            f"Causes: {'; '.join(hazard['causes'])}.{judged}",
            table(("control", "requirement", "where", "tests"), rows),
        ]
    return "\n\n".join(blocks)


def residual(tables: Tables) -> str:
    """What the controls do not cover."""
    rows = [(h["id"], h["title"], h["severity"], h["open"]) for h in tables["hazards"]["hazard"] if h.get("open")]
    return table(("hazard", "", "severity", "what remains"), rows)


def requirements(tables: Tables) -> str:
    """Each requirement with what it answers, where, and the tests; the item follows from the places."""
    rows, items = [], tables["items"]["item"]
    for row in tables["requirements"]["requirement"]:
        own = [(h["id"], c) for h, c in traces.controls(tables) if c["requirement"] == row["id"]]
        answers = ", ".join(dict.fromkeys(name for name, _ in own)) or row["need"]
        where = [place for _, c in own for place in c["where"]] + row.get("where", [])
        found = (traces.item_of(place.partition(" (")[0], items) for place in where)
        tests = [test for _, c in own for test in c["tests"]] + row.get("tests", [])
        parts = ", ".join(dict.fromkeys(item["id"] for item in found if item))
        rows.append((row["id"], row["text"], answers, parts, len(set(tests)), code(list(dict.fromkeys(tests))[:3])))
    return table(("requirement", "says", "answers", "items", "tests", "the first of them"), rows)


def traced(tables: Tables) -> str:
    """How many are traced."""
    controls, rows = traces.controls(tables), tables["requirements"]["requirement"]
    tests = {test for _, control in controls for test in control["tests"]}
    tests |= {test for row in rows for test in row.get("tests", [])}
    return (
        f"{len(tables['hazards']['hazard'])} hazards, {len(controls)} controls, {len(rows)} requirements, "
        f"{len(tests)} tests that are named: all traced, both ways."
    )


def items(tables: Tables) -> str:
    """Items with class, reason, and the class that the hazards ask for."""
    rows = [
        (
            row["title"],
            row["class"],
            traces.class_needed(row, tables),
            row["process"],
            row["reason"],
            code(row["paths"]),
        )
        for row in tables["items"]["item"]
    ]
    return table(("item", "class", "its hazards ask for", "runs in", "reason", "files"), rows)


def interfaces(tables: Tables) -> str:
    """Which item imports which, counted in the code."""
    named = {row["id"]: row for row in tables["items"]["item"]}
    rows = [
        (one, other, count, named[one].get("relies_on", {}).get(other, ""))
        for (one, other), count in sorted(traces.interfaces(tables["items"]["item"]).items())
    ]
    return table(("item", "imports", "imports, number", "of a lower class, because"), rows)


def contracts(_: Tables) -> str:
    """import-linter's contracts, as pyproject.toml has them."""
    linter = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    return table(("contract", "kind"), [(one["name"], one["type"]) for one in linter["contracts"]])


def soup_list(_: Tables) -> str:
    """The list of others' software, without its own title."""
    return soup.render().partition("\n# ")[2].partition("\n")[2].replace("\n## ", "\n### ")


def licences(_: Tables) -> str:
    """Which licences occur, and why they may."""
    listed = sbom.licences()
    found: dict[str, list[str]] = {}
    for name, *_rest in sbom.packages():
        found.setdefault(str(sbom.licence_of(name, listed["stated"])), []).append(name)
    rows = [(licence, len(set(names)), ", ".join(sorted(set(names)))) for licence, names in sorted(found.items())]
    allowed = table(("licence", "allowed because"), listed["allowed"].items())
    return allowed + "\n\n" + table(("licence", "packages", ""), rows)


def clauses(tables: Tables) -> str:
    """The stimulators' standard, with our figures from the code."""
    standard = tables["stimulator-standard"]
    ours, rows = figures.of_clauses(standard), []
    for row in standard["clause"]:
        number, unit = ours.get(row.get("ours", ""), (None, ""))
        said = "" if number is None else f"{number:.4g} {unit} (`{row['ours']}`)"
        most = f" ({row['at_most']:g} {unit})" if "at_most" in row else ""
        rows.append(
            (f"{row['topic']} (check: {row['number']})", row["says"] + most, said, row["answer"], code(row["tests"]))
        )
    return table(("clause", "asks, in our words", "at most, here", "answer", "tests"), rows)


def scenarios(tables: Tables) -> str:
    """What people do, what could go wrong, what stands against it."""
    severe = {h["id"] for h in tables["hazards"]["hazard"] if h["severity"] == "critical"}
    rows = [
        (
            f"{row['id']}{' *' if severe & set(row['hazards']) else ''}", row["who"], row["title"], row["wrong"],
            row["screen"], ", ".join(row["hazards"]), code(row["tests"]),
        )
        for row in tables["use"]["scenario"]
    ]  # fmt: skip
    return table(("", "who", "does", "what could go wrong", "on the screen", "hazards", "tests"), rows)


def trials(tables: Tables) -> str:
    """What was tried, by whom or what, and where it stands."""
    rows = [(row["what"], row["by"], row["found"], code([row["source"]])) for row in tables["use"]["trial"]]
    return table(("trial", "by", "found", "stands in"), rows)


def flows(tables: Tables) -> str:
    """The diagram, and its flows by number."""
    threats = tables["threats"]
    titles = {row["id"]: row["title"] for row in threats["element"]}
    rows = [(n, titles[f["from"]], titles[f["to"]], f["what"]) for n, f in enumerate(threats["flow"], 1)]
    return f"{drawing.draw(threats)}\n\n" + table(("", "from", "to", "what"), rows)


def threats(tables: Tables) -> str:
    """Each threat with what answers it."""
    rows = [
        (row["id"], ", ".join(row["on"]), row["stride"], row["text"], ", ".join(row.get("hazards", [])),
         code(row.get("tests", [])), row.get("open", ""))
        for row in tables["threats"]["threat"]
    ]  # fmt: skip
    return table(("", "on", "STRIDE", "threat", "controls of", "tests", "open"), rows)


def activities(tables: Tables) -> str:
    """What standards ask for, what is done where, what is missing."""
    rows = [
        (f"{row['standard']}, {row['clause']}", row["what"], code(row["where"]), row["state"], row.get("missing", ""))
        for row in tables["activities"]["activity"]
    ]
    return table(("standard", "done here", "where", "state", "missing"), rows)


def outside(tables: Tables) -> str:
    """The checklist of what others must do."""
    rows = [("☐", row["what"], row["owner"], row["when"]) for row in tables["activities"]["outside"]]
    return table(("", "what", "owner", "when"), rows)


def data_tables(tables: Tables) -> str:
    """What of a person is in which table."""
    data = tables["data-map"]
    rows = [
        (f"`{name}`", row["why"], ", ".join(row.get("person", [])), ", ".join(row.get("staff", [])), *_ends(row, data))
        for name, row in data["tables"].items()
    ]
    return table(("table", "why", "of the person who trains", "of staff", "how long", "how it goes"), rows)


def data_files(tables: Tables) -> str:
    """What of a person is in which file, and what is made on request."""
    data = tables["data-map"]
    rows = [
        (f"`{row['pattern']}`", row["holds"], "yes" if row["person"] else "no", *_ends(row, data))
        for row in data["files"]
    ]
    more = [(row["what"], row["holds"], code(row["tests"])) for row in data["elsewhere"]]
    kept = table(("file", "holds", "personal", "how long", "how it goes"), rows)
    return kept + "\n\n" + table(("elsewhere", "holds", "tests"), more)


def _ends(row: Row, data: Row) -> tuple[str, str]:
    """How long and how, with the words that stand for several rows."""
    return data["words"].get(row["until"], row["until"]), data["words"].get(row["deleted"], row["deleted"])
