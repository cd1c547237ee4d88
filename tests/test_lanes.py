"""`python -m tests`: a lane that fails, or that cannot be followed, is never lost."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.__main__ import CAMPAIGNS, LANES, SIDE_BY_SIDE, not_run, run

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_each_lane_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "test_good.py").write_text("def test_it(): pass")
    (tmp_path / "test_bad.py").write_text("def test_it(): assert 1 == 2")
    failures: list[str] = []
    lanes = {name: (str(tmp_path / f"test_{name}.py"), "-c", "/dev/null") for name in ("bad", "empty")}
    lanes |= {"lost": ("\0",)}  # no program takes such an argument
    lanes |= {"good": (str(tmp_path / "test_good.py"), "-c", "/dev/null")}
    codes = run(lanes, failures)
    assert codes == {"bad": 1, "empty": 4, "lost": 1, "good": 0}
    told = [line for line in failures if line.startswith("[bad] ")]
    assert any("assert 1 == 2" in line for line in told)
    assert any("FAILED" in line for line in told)
    assert any(line.startswith("[lost] ") for line in failures)
    assert "[good] " in capsys.readouterr().out


@pytest.mark.slow
def test_a_test_process_that_dies_is_a_failure(tmp_path: Path) -> None:
    lines = ["import os", "def test_before(): pass", "def test_dies(): os._exit(0)", "def test_after(): pass"]
    (tmp_path / "test_dies.py").write_text("\n".join(lines))
    failures: list[str] = []
    codes = run({"side": (*SIDE_BY_SIDE, "2", "-c", "/dev/null", str(tmp_path))}, failures)
    assert codes == {"side": 1}
    assert any("test_dies" in line for line in failures)


def test_each_test_is_in_one_lane_and_campaigns_are_told_with_their_commands() -> None:
    lanes = {name: arguments for name, arguments in LANES.items() if name != "postgresql"}
    chosen = {arguments[arguments.index("-m") + 1] for arguments in lanes.values()}
    assert chosen == {"not wire", "wire and not realtime", "realtime"}
    assert all("tests" in arguments for arguments in lanes.values())
    again = [word for word in LANES["postgresql"] if word.startswith("tests/")]
    assert again and all((ROOT / path).is_file() for path in again), "some of the first lane's, on PostgreSQL"
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    assert {command.removeprefix("make ") for command in CAMPAIGNS} <= targets
    assert all(command in not_run() for command in CAMPAIGNS)
