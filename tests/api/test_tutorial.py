"""docs/tutorial.md does what it says: its commands are run, its blocks executed in order."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import stimrig
from tests.harness import few_effects

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "tutorial.md").read_text("utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_every_block_runs_in_order(tmp_path: Path) -> None:
    (command,) = blocks("sh")
    assert command.startswith("python -m bench.muscles.hidden_records")
    words = [sys.executable, *command.split()[1:]]
    words[words.index("data")] = str(tmp_path)
    subprocess.run(words, check=True, cwd=ROOT, capture_output=True)
    (path,) = tmp_path.glob("*.csv")
    scope: dict[str, object] = {"path": path}
    pieces = blocks("python")
    assert len(pieces) == 12
    with few_effects.only("asymmetric_relaxation", "fatigue", "output_saturation", "free_gate", "free_speed"):
        for piece in pieces:
            exec(compile(piece, "tutorial.md", "exec"), scope)
    free: Any = scope["free"]
    opened_ms, closed_ms = (int(one) for one in re.findall(r"(\d+) ms", free["words"]))
    assert 15 <= opened_ms <= 25 and 70 <= closed_ms <= 90, free["words"]
    figure = stimrig.plot(scope["better"])  # pyright: ignore[reportArgumentType]
    assert [trace.name for trace in figure.data] == ["fitted pulses", "held-out pulses"]
    drawn = stimrig.plot(scope["model"], scope["record"])  # pyright: ignore[reportArgumentType]
    assert {"measured", "model, free run", "measured − model", "pulse width"} <= {trace.name for trace in drawn.data}


def test_plot_of_something_else_says_what_it_takes() -> None:
    with pytest.raises(stimrig.errors.BadRequest, match=r"plot\(model, record\)"):
        stimrig.plot({})
