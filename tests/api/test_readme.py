"""The README's commands: those of the command line are run, those of make are in the Makefile, links lead somewhere."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from stimrig.api.cli import main
from stimrig.api.cli.commands import test as test_verb
from stimrig.api.cli.errors import InputError
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
@pytest.mark.timeout(900)  # nine commands, a test among them
def test_commands_do_what_they_are_said_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first test is played, shorter, and stands in for the other; a diagnosis has two effects to choose from."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STIMRIG_WORKERS", "1")  # each loads and compiles for seconds before it is needed
    commands = blocks("sh")
    assert len(commands) >= 9
    with few_effects.only("fatigue", "output_saturation"):
        for command in commands:
            program, *words = shlex.split(command)
            assert program == "stimrig"
            if words[0] == "test" and "--emulate" in words:
                with monkeypatch.context() as patch:
                    patch.setattr(test_verb, "service", played := Mock(side_effect=InputError("not now")))
                    assert main.run(words) == 2 and played.call_args.args[3] == words[words.index("--emulate") + 1]
                shutil.copy("out/first.h5", words[words.index("-o") + 1])
                continue
            if words[0] in ("test", "emulate"):  # they do not come back into this process
                short = ["--protocol", "short"] if words[0] == "test" else []
                subprocess.run([sys.executable, "-m", "stimrig", *words, *short], check=True, timeout=300)
                continue
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                assert main.run(words) == 0, command
            assert out.getvalue().strip(), command
    for name in ("first.h5", "MODEL.json", "predicted.csv", "report.html", "hidden.h5", "story.html", "better.json"):
        assert (tmp_path / "out" / name).stat().st_size > 1000, name
