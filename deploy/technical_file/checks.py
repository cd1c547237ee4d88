"""Threats, use, the stimulators' standard, activities and the map of data against the code: a line for each fault."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

from deploy.technical_file import figures, places, traces
from deploy.technical_file.places import ROOT, SAFETY, Row, Tables

LETTERS = {"outside": "SR", "process": "STRIDE", "store": "TRID", "flow": "TID"}
"""What is looked at for each kind of element after STRIDE, and for a flow that crosses a boundary."""
STATES = ("done", "partly", "not done")
FILE_NAME = re.compile(r"[\w.-]+\.(json|lock|db|log|journal|sqlite|jsonl|csv|h5|pem|key)")
ON_REQUEST = ("api/cohort/", "api/exchange/", "api/cli/", "api/centre/postgres.py", "api/web/", "rig/devices/")
"""Code whose file names are of what somebody asked for, of PostgreSQL's demo, or of what is read only."""


def faults(tables: Tables, invariants: set[str]) -> list[str]:
    """Everything that does not hold, a line each."""
    return [
        *traces.hazard_faults(tables["hazards"]["hazard"], invariants),
        *traces.requirement_faults(tables),
        *traces.item_faults(tables),
        *threat_faults(tables),
        *use_faults(tables),
        *standard_faults(tables["stimulator-standard"]),
        *activity_faults(tables["activities"]),
        *data_faults(tables["data-map"]),
    ]


def threat_faults(tables: Tables) -> Iterator[str]:
    """Threats that nothing answers, and elements and flows for which a letter was not looked at."""
    table = tables["threats"]
    kinds = {row["id"]: row.get("kind") for row in table["element"]}
    homes = {row["id"]: row.get("boundary") for row in table["element"]}
    needed = {name: LETTERS.get(str(kind), "") for name, kind in kinds.items()}
    yield from places.unique([*table["element"], *table["flow"], *table["threat"]])
    bounds = {row["id"] for row in table["boundary"]}
    yield from (
        f"element {name}: no such boundary or kind" for name in kinds if not needed[name] or homes[name] not in bounds
    )
    for row in table["flow"]:
        ends = {row["from"], row["to"]}
        yield from (f"flow {row['id']}: no such element: {one}" for one in sorted(ends - kinds.keys()))
        needed[row["id"]] = LETTERS["flow"] if len({homes.get(one) for one in ends}) == 2 else ""
    hazards = {row["id"] for row in tables["hazards"]["hazard"]}
    looked: dict[str, set[str]] = {name: set() for name in needed}
    for row in table["threat"]:
        said = [*places.left_out(row, "text", "on", "stride"), *places.missing_tests(row.get("tests", []))]
        said += [f"no such hazard: {one}" for one in row.get("hazards", []) if one not in hazards]
        said += [f"no such element or flow: {one}" for one in row["on"] if one not in needed]
        if not (row.get("hazards") or row.get("tests") or row.get("open")):
            said.append("neither hazards, tests nor open")
        yield from (f"threat {row['id']}: {fault}" for fault in said)
        for one in row["on"]:
            looked.setdefault(one, set()).update(row["stride"])
    for name, letters in needed.items():
        if lacking := "".join(letter for letter in letters if letter not in looked[name]):
            yield f"{name}: no threat of {lacking}"


def use_faults(tables: Tables) -> Iterator[str]:
    """Scenarios without a test, hazards that are not there, and what was quoted of trials and does not stand there."""
    hazards = {row["id"] for row in tables["hazards"]["hazard"]}
    rows = tables["use"]["scenario"]
    yield from places.unique(rows)
    for row in rows:
        said = [*places.left_out(row, "who", "title", "wrong", "screen", "hazards", "tests")]
        said += [
            *places.missing_tests(row["tests"]),
            *(f"no such hazard: {h}" for h in row["hazards"] if h not in hazards),
        ]
        yield from (f"scenario {row['id']}: {fault}" for fault in said)
    for row in tables["use"]["trial"]:
        text = (ROOT / row["source"]).read_text("utf-8")
        said = [
            *places.left_out(row, "what", "by", "found"),
            *(f"{q!r} is not in it" for q in row["quotes"] if q not in text),
        ]
        yield from (f"trial of {row['source']}: {fault}" for fault in said)


def standard_faults(standard: Row) -> Iterator[str]:
    """A limit of ours that is wider than the standard's, no figure or no test."""
    ours = figures.of_clauses(standard)
    area = f"{standard['electrode_area_cm2']:g} cm²"
    if area not in (SAFETY / "intended-use.md").read_text("utf-8"):
        yield f"stimulator-standard: intended-use.md does not ask for electrodes of {area}"
    for row in standard["clause"]:
        said = [
            *places.left_out(row, "topic", "number", "says", "answer", "tests"),
            *places.missing_tests(row["tests"]),
        ]
        if "ours" in row and row["ours"] not in ours:
            said.append(f"no such figure: {row['ours']}")
        elif "at_most" in row and not (ours[row["ours"]][0] <= row["at_most"]):
            said.append(f"{row['ours']} is {ours[row['ours']][0]:g}, above {row['at_most']:g}")
        yield from (f"clause {row.get('topic', '?')}: {fault}" for fault in said)


def activity_faults(table: Row) -> Iterator[str]:
    """Places that are not there; what is not done and does not say what is missing; a checklist without an owner."""
    for row in table["activity"]:
        said = [*places.left_out(row, "standard", "clause", "what", "where"), *places.missing_places(row["where"])]
        if row.get("state") not in STATES or (row["state"] != "done") != bool(row.get("missing")):
            said.append("state must be done, or partly or not done with what is missing")
        yield from (f"activity {row['standard']} {row['clause']}: {fault}" for fault in said)
    for row in table["outside"]:
        yield from (f"outside: {row.get('what', '?')}: {fault}" for fault in places.left_out(row, "owner", "when"))


def data_faults(data: Row) -> Iterator[str]:
    """Tables, columns and names of files that the map lacks, or that are no longer there."""
    from stimrig.api.store import centre_tables, tables  # noqa: F401

    there = {name: {column.name for column in table.columns} for name, table in tables.Table.metadata.tables.items()}
    told = {
        name: [*row.get("person", []), *row.get("staff", []), *row.get("other", [])]
        for name, row in data["tables"].items()
    }
    for name in sorted(there.keys() | told.keys()):
        lacking, gone = (
            there.get(name, set()) - set(told.get(name, [])),
            set(told.get(name, [])) - there.get(name, set()),
        )
        yield from (f"data map: {name}.{column} is not in it" for column in sorted(lacking))
        yield from (f"data map: {name}.{column} is no longer there" for column in sorted(gone))
        if len(told.get(name, [])) > len(set(told.get(name, []))):
            yield f"data map: {name}: a column twice"
    for name, row in [*data["tables"].items(), *((row["pattern"], row) for row in data["files"])]:
        keys = ("why", "until", "deleted") if name in there else ("holds", "until", "deleted")
        yield from (f"data map: {name}: {fault}" for fault in places.left_out(row, *keys))
    for row in data["elsewhere"]:
        said = [*places.left_out(row, "what", "holds", "tests"), *places.missing_tests(row["tests"])]
        yield from (f"data map: {row['what']}: {fault}" for fault in said)
    yield from (
        f"data map: no kind of file for {name}, in {where}" for where, name in written() if not is_mapped(name, data)
    )


def unmapped(folder: Path, data: Row) -> list[str]:
    """Files below a data folder of which the map has no kind."""
    there = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    return [path for path in there if not is_mapped(path, data)]


def is_mapped(path: str, data: Row) -> bool:
    """Whether a file, by its path below a data folder or by its bare name, is of a kind in the map."""
    patterns = [row["pattern"] for row in data["files"]]
    names = [] if "/" in path else [pattern.rpartition("/")[2] for pattern in patterns if not pattern.endswith("/**")]
    return any(fnmatch(path, pattern.replace("**/", "*")) for pattern in (*patterns, *names))


@cache
def written() -> tuple[tuple[str, str], ...]:
    """Place and name of each file that the code of rig and service names in a text."""
    code = [path for path in traces.sources() if path.startswith(("rig/", "api/")) and not path.startswith(ON_REQUEST)]
    texts = (
        (path, node.value)
        for path in code
        for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return tuple((path, text) for path, text in texts if FILE_NAME.fullmatch(text))
