"""docs/tutorial.md does what it says: its commands are run, its blocks executed in order."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import stimrig
from bench.muscles import hidden_records
from tests.harness import few_effects

TEXT = (Path(__file__).parents[2] / "docs" / "tutorial.md").read_text("utf-8")
STRANGE = re.compile(r"^## A muscle that no library holds\n.*?(?=^## )", re.MULTILINE | re.DOTALL)


def blocks(language: str, text: str = TEXT) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("strange", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_every_block_runs_in_order(tmp_path: Path, strange: bool) -> None:
    """The section on a strange muscle takes a minute; tests/identify/test_free_effects.py has a short one."""
    (command,) = blocks("sh")
    program, words = command.split()[:3], command.split()[3:]
    assert program == ["python", "-m", "bench.muscles.hidden_records"]
    words[words.index("data")] = str(tmp_path)
    assert hidden_records.main(words) == 0
    (path,) = tmp_path.glob("*.csv")
    scope: dict[str, Any] = {"path": path}
    pieces = blocks("python", TEXT if strange else STRANGE.sub("", TEXT))
    assert len(pieces) == (12 if strange else 8)
    more = ("output_saturation", "free_gate", "free_speed") if strange else ()
    with few_effects.only("asymmetric_relaxation", "fatigue", *more):
        for piece in pieces:
            exec(compile(piece, "tutorial.md", "exec"), scope)
    if strange:
        opened_ms, closed_ms = (int(one) for one in re.findall(r"(\d+) ms", scope["free"]["words"]))
        assert 15 <= opened_ms <= 25 and 70 <= closed_ms <= 90, scope["free"]["words"]
    assert [*stimrig.plot(scope["better"]).lines()] == ["fitted pulses", "held-out pulses"]
