#!/usr/bin/env python3
"""Software of unknown provenance (SOUP): docs/safety/soup.md from the locked lists and deploy/soup.toml.

soup.py           write the list
soup.py --check   exit 1 and one line where it is out of date
"""

from __future__ import annotations

import re
import sys
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
LOCK, EXTRAS = ROOT / "requirements" / "run.txt", ROOT / "requirements" / "centre.txt"
NOTES = ROOT / "deploy" / "soup.toml"
LIST = ROOT / "docs" / "safety" / "soup.md"
PIN = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^\s;]+)(?:\s*;\s*(?P<marker>.*?))?\s*\\?$")
CLASSES = ("rig", "model", "service", "none")


class SoupError(Exception):
    """One line: what does not hold."""


def pins(text: str, name: str = LOCK.name) -> list[tuple[str, str, str]]:
    """Name, version and marker of each package in a locked list.

    Raises SoupError: a line that is neither a pin, a hash nor a comment.
    """
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if not stripped or stripped.startswith(("#", "--hash=")):
            continue
        match = PIN.match(stripped)
        if match is None:
            raise SoupError(f"{name}:{number}: not a pin: {stripped}")
        found.append((match["name"], match["version"], match["marker"] or ""))
    return found


def notes() -> dict[str, Any]:
    """What a person wrote of each package, and of what lies below them."""
    return tomllib.loads(NOTES.read_text("utf-8"))


def render() -> str:
    """The list as Markdown.

    Raises SoupError: a package without a note, a note without a package, or an unknown class.
    """
    written, locked = notes(), pins(LOCK.read_text("utf-8"))
    packages, extras = written["package"], written["extra"]
    more = [pin for pin in pins(EXTRAS.read_text("utf-8"), EXTRAS.name) if pin[0] not in packages]
    for listed, told in ((locked, packages), (more, extras)):
        names = {name for name, _, _ in listed}
        for what, missing in (("no note for", names - told.keys()), ("no longer locked", told.keys() - names)):
            if missing:
                raise SoupError(f"deploy/soup.toml: {what}: {', '.join(sorted(missing))}")
    for name, note in (packages | extras | written["below"]).items():
        if note["class"] not in CLASSES or not note["for"].strip():
            raise SoupError(f"deploy/soup.toml: {name}: class must be one of {', '.join(CLASSES)}, with a purpose")
    lines = [written["head"], f"## Locked packages ({len(packages)})\n", *_table(locked, packages)]
    lines += ["", f"## Only with an extra ({len(extras)})", "", *_table(more, extras)]
    lines += ["", "## What they must do, and known anomalies", "", *_anomalies(packages | extras, written["anomalies"])]
    lines += ["", "## Below them", "", "| software | version | class | what for |", "|---|---|---|---|"]
    lines += [f"| {name} | {n['version']} | {n['class']} | {n['for']} |" for name, n in written["below"].items()]
    return "\n".join(lines) + "\n"


def _anomalies(told: dict[str, Any], known: dict[str, Any]) -> list[str]:
    """Each package's faults as a person found them; those of class rig all have an entry.

    Raises SoupError: one has none, an entry is of no package, or leaves a part out.
    """
    needed = {name for name, note in told.items() if note["class"] == "rig"}
    for what, names in (
        ("not looked at", needed - known.keys()),
        ("anomalies of no package", known.keys() - told.keys()),
    ):
        if names:
            raise SoupError(f"deploy/soup.toml: {what}: {', '.join(sorted(names))}")
    lines = ["| package | must | known | here | looked at |", "|---|---|---|---|---|"]
    for name, note in sorted(known.items(), key=lambda one: (CLASSES.index(told[one[0]]["class"]), one[0])):
        said = [note["must"], note["known"], note["here"]]
        if not (all(map(str.strip, said)) and isinstance(note["looked_at"], date)):
            raise SoupError(f"deploy/soup.toml: anomalies.{name}: needs must, known, here and looked_at, a date")
        lines.append(f"| {name} | {' | '.join(said)} | {note['looked_at']} |")
    rest = "; ".join(f"{one}: {sum(n['class'] == one for n in told.values())}" for one in CLASSES)
    return [*lines, "", f"Packages by class: {rest}. Those without a row were not looked at one by one."]


def _table(locked: list[tuple[str, str, str]], told: dict[str, Any]) -> list[str]:
    lines = ["| package | version | class | what for |", "|---|---|---|---|"]
    for name, version, marker in sorted(locked, key=lambda pin: (CLASSES.index(told[pin[0]]["class"]), pin)):
        where = f" ({marker})" if marker else ""
        lines.append(f"| {name} | {version}{where} | {told[name]['class']} | {told[name]['for']} |")
    return lines


def main(arguments: list[str]) -> int:
    """Write or check; the exit code."""
    try:
        text = render()
    except (SoupError, OSError, KeyError, tomllib.TOMLDecodeError) as error:
        print(f"soup.py: {error}", file=sys.stderr)
        return 1
    if "--check" not in arguments:
        LIST.write_text(text, "utf-8")
    elif not LIST.exists() or LIST.read_text("utf-8") != text:
        print("soup.py: docs/safety/soup.md is out of date: run deploy/soup.py", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
