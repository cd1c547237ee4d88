"""The README's commands: those of the command line are run, those of make are in the Makefile, links lead somewhere."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from stimrig.api.cli import main
from tests.harness import few_effects

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")


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
@pytest.mark.timeout(900)  # nine commands, two tests among them
def test_commands_do_what_they_are_said_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests are played shorter; a diagnosis has two effects to choose from."""
    monkeypatch.chdir(tmp_path)
    commands = blocks("sh")
    assert len(commands) >= 9
    with few_effects.only("fatigue", "output_saturation"):
        for command in commands:
            program, *words = shlex.split(command)
            assert program == "stimrig"
            if words[0] == "test":
                hidden = words[words.index("--emulate") + 1] if "--emulate" in words else ""
                words += ["--protocol", "short", "--emulate", hidden]
            if words[0] in ("test", "emulate"):  # they do not come back into this process
                subprocess.run([sys.executable, "-m", "stimrig", *words], check=True, timeout=300)
                continue
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                assert main.run(words) == 0, command
            assert out.getvalue().strip(), command
    for name in ("first.h5", "MODEL.json", "predicted.csv", "report.html", "hidden.h5", "story.html", "better.json"):
        assert (tmp_path / "out" / name).stat().st_size > 1000, name
