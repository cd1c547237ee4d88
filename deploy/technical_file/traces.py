"""Hazard, control, requirement, item, test: each traced both ways. What does not hold is a line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cache

from deploy.technical_file import places
from deploy.technical_file.places import ROOT, Row, Tables

CLASS_OF = {"critical": "C", "serious": "B", "minor": "A"}
"""Safety class after IEC 62304 that a hazard of a severity asks of the items that hold its controls."""
PACKAGES = ("api", "rig", "identify", "hardware_sim")


def hazard_faults(hazards: list[Row], invariants: set[str]) -> Iterator[str]:
    """What does not hold in the list of hazards; `invariants`: those that the simulator judges."""
    yield from places.unique(hazards)
    for hazard in hazards:
        name, controls = hazard.get("id", "?"), hazard.get("control", [])
        said = [*places.left_out(hazard, "title", "harm", "causes", "control")]
        if hazard.get("severity") not in CLASS_OF:
            said.append(f"severity {hazard.get('severity')!r}")
        said += [f"no such invariant: {one}" for one in hazard.get("invariants", []) if one not in invariants]
        if hazard.get("severity") == "critical" and len(controls) < 2:
            said.append("critical, and one control alone")
        yield from (f"{name}: {fault}" for fault in said)
        yield from (f"{name}: {fault}" for control in controls for fault in control_faults(control))


def control_faults(control: Row) -> Iterator[str]:
    """What does not hold in one control."""
    what = control.get("what") or "a control without words"
    for fault in (
        *places.left_out(control, "what", "where", "tests", "requirement"),
        *places.missing_places(control.get("where", [])),
        *places.missing_tests(control.get("tests", [])),
    ):
        yield f"{what}: {fault}"


def requirement_faults(tables: Tables) -> Iterator[str]:
    """A requirement without control and need, one without a test, a control of none."""
    rows = tables["requirements"]["requirement"]
    yield from places.unique(rows)
    named = {control.get("requirement") for _, control in controls(tables)}
    yield from (f"no such requirement: {one}" for one in sorted(map(str, named - {row["id"] for row in rows} - {None})))
    for row in rows:
        said = [*places.left_out(row, "text"), *places.missing_places(row.get("where", []))]
        said += places.missing_tests(row.get("tests", []))
        if row["id"] not in named:
            said += places.left_out(row, "need", "where", "tests")
        yield from (f"requirement {row['id']}: {fault}" for fault in said)


def controls(tables: Tables) -> list[tuple[Row, Row]]:
    """Each control with its hazard."""
    return [(hazard, control) for hazard in tables["hazards"]["hazard"] for control in hazard.get("control", [])]


def item_of(path: str, items: list[Row]) -> Row | None:
    """The item with the longest path that this one begins with."""
    begun = [
        (len(start), row) for row in items for start in row["paths"] if path == start or path.startswith(f"{start}/")
    ]
    return max(begun, key=lambda one: one[0])[1] if begun else None


def item_faults(tables: Tables) -> Iterator[str]:
    """Files of no item, classes below those of the hazards that an item controls, or below those that rely on it."""
    items = tables["items"]["item"]
    yield from places.unique(items)
    for row in items:
        said = [*places.left_out(row, "title", "paths", "process", "reason"), *places.missing_places(row["paths"])]
        if row.get("class") not in CLASS_OF.values():
            said.append(f"class {row.get('class')!r}")
        elif row["class"] < (needed := class_needed(row, tables)):
            said.append(f"class {row['class']}, and it controls hazards that ask for {needed}")
        yield from (f"item {row['id']}: {fault}" for fault in said)
    yield from (f"{file}: belongs to no item" for file in sources() if item_of(file, items) is None)
    for one, other in sorted(interfaces(items)):
        low, reasons = item_named(other, items), item_named(one, items).get("relies_on", {})
        if low["class"] < item_named(one, items)["class"] and other not in reasons:
            yield f"item {one}: imports {other}, which is of a lower class; relies_on says no reason"


def class_needed(item: Row, tables: Tables) -> str:
    """The class that the worst hazard asks of an item which holds a control of it."""
    items = tables["items"]["item"]
    worst = [
        CLASS_OF.get(hazard.get("severity", ""), "C")
        for hazard, control in controls(tables)
        if any(item_of(place.partition(" (")[0], items) is item for place in control.get("where", []))
    ]
    return max(worst, default="A")


def item_named(name: str, items: list[Row]) -> Row:
    """The item of an id."""
    return next(row for row in items if row["id"] == name)


def sources() -> list[str]:
    """Every source file of the packages, as paths from the top."""
    return [
        path.relative_to(ROOT).as_posix()
        for package in (*PACKAGES, "stimrig")
        for path in sorted((ROOT / package).rglob("*.py"))
    ]


@cache
def imports() -> frozenset[tuple[str, str]]:
    """Which module imports which, as import-linter reads them."""
    import grimp  # of the test environment

    graph = grimp.build_graph("stimrig", cache_dir=None)
    return frozenset((one, other) for one in graph.modules for other in graph.find_modules_directly_imported_by(one))


def interfaces(items: list[Row]) -> Counter[tuple[str, str]]:
    """How many imports lead from one item to another."""
    homes = {module: item_of(_path(module), items) for pair in imports() for module in pair}
    between = ((homes[one], homes[other]) for one, other in imports())
    return Counter((one["id"], other["id"]) for one, other in between if one and other and one is not other)


@cache
def _path(module: str) -> str:
    parts = module.split(".")
    path = "/".join(parts[1:] if len(parts) > 1 and parts[1] in PACKAGES else parts)
    return f"{path}.py" if (ROOT / f"{path}.py").exists() else path
