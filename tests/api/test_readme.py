"""The README's commands: those of the command line are run, those of make are in the Makefile, links lead somewhere."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")
SPEED = "--speed 8"


def blocks(language: str) -> list[str]:
    """The lines of all fenced blocks in a language."""
    found, inside = [], None
    for line in README.splitlines():
        if line.startswith("```"):
            inside = line[3:] if inside is None else None
        elif inside == language and line.strip():
            found.append(line)
    return found


def test_make_commands_are_targets_of_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    wanted = [words.split()[1] for words in blocks("") + re.findall(r"`(make [^`]*)`", README)]
    assert {"demo", "test", "serve"} <= set(wanted) <= targets


def test_links_and_pictures_are_there() -> None:
    names = re.findall(r"\]\(([^)#]+)\)", README)
    assert {"docs/img/page.png", "docs/img/why.png"} <= set(names)
    assert [name for name in names if "://" not in name and not (ROOT / name).exists()] == []
    assert all((ROOT / name).stat().st_size < 300_000 for name in names if name.endswith(".png"))


@pytest.mark.wire
@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.timeout(900)  # eleven commands, whole tests among them
def test_commands_do_what_they_are_said_to(tmp_path: Path) -> None:
    commands = blocks("sh")
    assert len(commands) >= 9
    for command in commands:
        words = shlex.split(command)
        assert words[0] == "stimrig"
        if words[1] == "test":  # the same test, at eight times the speed of the world
            place = words.index("--emulate") + 1 if "--emulate" in words else None
            words = (
                [*words[:place], f"{words[place]} {SPEED}", *words[place + 1 :]]
                if place
                else [*words, "--emulate", SPEED]
            )
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        done = subprocess.run(
            [sys.executable, "-m", "api.cli", *words[1:]],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=240,
        )
        assert done.returncode == 0, (command, done.stderr)
        assert done.stdout.strip(), command
    for name in ("first.h5", "MODEL.json", "predicted.csv", "report.html", "hidden.h5", "improved.html"):
        assert (tmp_path / "out" / name).stat().st_size > 1000, name
