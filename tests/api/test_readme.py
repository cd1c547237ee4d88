"""README, tutorial and docs/python.md do what they say: commands and blocks run, targets of make and links exist."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

import stimrig
from bench.muscles import hidden_records
from stimrig.api.cli import main
from stimrig.api.cli.commands import test as test_verb
from stimrig.api.cli.errors import InputError
from tests.api.conftest import TOKEN, Service
from tests.api.test_jobs import made_up_csv
from tests.harness import few_effects

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")


def blocks(language: str, text: str = README) -> list[str]:
    """The fenced blocks of a page in a language."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [block for kind, block in found if kind == language]


def test_make_commands_are_targets_of_the_makefile() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    wanted = [words.split()[1] for words in "".join(blocks("")).splitlines() + re.findall(r"`(make [^`]*)`", README)]
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
    commands = "".join(blocks("sh")).splitlines()
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


# ---- docs/tutorial.md does what it says: its commands are run, its blocks executed in order --------------------------


TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
STRANGE = re.compile(r"^## A muscle that no library holds\n.*?(?=^## )", re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("strange", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_every_block_runs_in_order(tmp_path: Path, strange: bool) -> None:
    """The section on a strange muscle takes a minute; tests/identify/test_free_effects.py has a short one."""
    (command,) = blocks("sh", TUTORIAL)
    program, words = command.split()[:3], command.split()[3:]
    assert program == ["python", "-m", "bench.muscles.hidden_records"]
    words[words.index("data")] = str(tmp_path)
    assert hidden_records.main(words) == 0
    (path,) = tmp_path.glob("*.csv")
    scope: dict[str, Any] = {"path": path}
    pieces = blocks("python", TUTORIAL if strange else STRANGE.sub("", TUTORIAL))
    assert len(pieces) == (12 if strange else 8)
    more = ("output_saturation", "free_width_by_torque", "free_torque_by_drive") if strange else ()
    with few_effects.only("asymmetric_relaxation", "fatigue", *more):
        for piece in pieces:
            exec(compile(piece, "tutorial.md", "exec"), scope)
    if strange:
        assert -0.3 < scope["free"]["parameters"]["change"]["value"] < -0.15
    assert [*stimrig.plot(scope["better"]).lines()] == ["fitted pulses", "held-out pulses"]


PYTHON = (ROOT / "docs" / "python.md").read_text("utf-8")


def test_every_block_of_the_page_on_python_runs_in_order(tmp_path: Path, service: Service) -> None:
    pieces = blocks("python", PYTHON)
    assert len(pieces) >= 9
    path, other = made_up_csv(tmp_path / "first.csv"), tmp_path / "other.csv"
    stimrig.save((record := stimrig.read(path)).with_torque(1.1 * record.torque_nm), other)
    scope: dict[str, Any] = {"path": path, "other_path": other, "folder": tmp_path, "url": service.url, "token": TOKEN}
    with few_effects.only("threshold_drift", "recruitment_hysteresis"):
        for piece in pieces:
            exec(compile(piece, "python.md", "exec"), scope)
    assert (scope["run"]["ok"], scope["run"]["errors"]) == (1, 0)
