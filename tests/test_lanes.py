"""`python -m tests`: a lane that fails, or that cannot be followed, is never lost, and what is told of it is so."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from itertools import chain, combinations
from pathlib import Path

import pytest

from tests.__main__ import CAMPAIGNS, LANES, collected, dearest, main, not_run, plan, run
from tests.runner.changed_types import checked, imports_of, keys
from tests.runner.costs import AGAIN, Costs, Progress, repeating
from tests.runner.lanes import TOGETHER

ROOT = Path(__file__).parents[1]
MARKERS = ("wire", "realtime", "browser", "service", "slow", "sqlite")


@pytest.mark.slow
def test_each_lane_counts_and_what_failed_is_told_with_the_command_that_repeats_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "test_good.py").write_text("def test_it(): pass")
    (tmp_path / "test_bad.py").write_text("def test_it(): assert 1 == 2")
    (tmp_path / "test_broken.py").write_text("import nothing_of_this_name")
    failures: list[str] = []
    alone = ("-c", "/dev/null", f"--rootdir={tmp_path}")
    lanes = {name: (str(tmp_path / f"test_{name}.py"), *alone) for name in ("bad", "broken", "empty")}
    lanes |= {"lost": ("\0",)}  # no program takes such an argument
    lanes |= {"good": (str(tmp_path / "test_good.py"), *alone)}
    codes = run(lanes, failures, tmp_path / "kept")
    assert codes == {"bad": 1, "broken": 2, "empty": 4, "lost": 1, "good": 0}
    told = [line for line in failures if line.startswith("[bad] ")]
    assert any("assert 1 == 2" in line for line in told)
    assert any("FAILED" in line for line in told)
    assert any(line.startswith("[lost] ") for line in failures)
    assert any(line.startswith(f"[broken] {AGAIN}") for line in failures)
    assert "[good] " in capsys.readouterr().out
    (again,) = [line.partition(AGAIN)[2] for line in told if AGAIN in line]
    command = [sys.executable, *shlex.split(again)[1:], *alone]
    repeated = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (repeated.returncode, "assert 1 == 2" in repeated.stdout) == (1, True), repeated.stdout
    assert "test_bad.py::test_it" in dearest(["bad", "good"], tmp_path / "kept")


@pytest.mark.slow
def test_a_test_process_that_dies_is_a_failure(tmp_path: Path) -> None:
    lines = ["import os", "def test_before(): pass", "def test_dies(): os._exit(0)", "def test_after(): pass"]
    (tmp_path / "test_dies.py").write_text("\n".join(lines))
    failures: list[str] = []
    codes = run({"side": (*TOGETHER, "2", "-c", "/dev/null", str(tmp_path))}, failures, tmp_path)
    assert codes == {"side": 1}
    assert any(AGAIN in line and "test_dies" in line for line in failures)


def test_each_test_is_in_one_lane() -> None:
    for markers in chain.from_iterable(combinations(MARKERS, count) for count in range(len(MARKERS) + 1)):
        if "realtime" in markers and "wire" not in markers:
            continue  # what is `realtime` is also `wire`
        held = [name for name, lane in LANES.items() if lane.holds("tests/rig/test_gate.py::test_it", set(markers))]
        assert len(held) == 1, markers
    again = LANES["postgresql"].paths
    assert again and all((ROOT / path).is_file() for path in again), "some of the service's, on PostgreSQL"


def test_a_lane_reads_only_the_files_that_hold_its_tests() -> None:
    tests = {"tests/rig/test_gate.py::test_it": set[str](), "tests/wire/test_lsl.py::test_it[a::b]": {"wire"}}
    assert LANES["fast"].arguments(tests)[-1] == "tests/rig/test_gate.py"
    assert "tests/wire/test_lsl.py" not in LANES["fast"].arguments(tests)
    assert LANES["fast"].arguments({})[-1] == "tests"


def test_campaigns_are_told_with_their_commands() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    assert {command.removeprefix("make ") for command in CAMPAIGNS} <= targets
    assert all(command in not_run() for command in CAMPAIGNS)


@pytest.mark.slow
def test_the_plan_counts_what_pytest_runs() -> None:
    lane, file = LANES["fast"], "tests/rig/test_gate.py"
    command = [sys.executable, "-m", "pytest", "--collect-only", "-qq", "-m", lane.marks, file]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    count = sum(int(number) for number in re.findall(r": (\d+)$", listed, re.M))
    assert count > 0
    assert re.search(rf"fast +{count} tests", plan({"fast": lane}, collected(file)))


def test_an_unknown_lane_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["quick"]) == 2
    assert "fast" in capsys.readouterr().err


def test_progress_is_by_cost_and_not_by_number(tmp_path: Path) -> None:
    path = tmp_path / "lane.json"
    path.write_text(json.dumps({"wall_s": 200.0, "tests": {"dear": 90.0, "cheap": 10.0}}))
    progress = Progress(path, ())
    progress.tests = ["dear", "cheap"]
    assert progress.line(20.0).endswith("0 %, 0 of 2 tests, 3:00 left")
    progress.done = {"cheap"}
    assert progress.line(10.0).endswith("10 %, 1 of 2 tests, 1:30 left")
    progress.failed = {"cheap": ""}
    progress.done = {"cheap", "dear"}
    assert progress.line(100.0).endswith("100 %, 2 of 2 tests, 0:00 left, 1 failed")


def test_a_broken_run_keeps_what_the_one_before_knew(tmp_path: Path) -> None:
    path = tmp_path / "lane.json"
    path.write_text(json.dumps({"wall_s": 200.0, "tests": {"dear": 90.0, "gone": 10.0}}))
    progress = Progress(path, ())
    progress.tests, progress.costs, progress.done = ["dear", "new"], {"new": 1.0}, {"new"}
    progress.pytest_sessionfinish()
    assert (Costs(path).wall_s, Costs(path).tests) == (200.0, {"dear": 90.0, "new": 1.0})
    path.write_text("no JSON")
    assert (Costs(path).wall_s, Costs(path).tests) == (None, {})


def test_a_name_with_spaces_is_repeated_as_one_word() -> None:
    test = "tests/rig/test_gate.py::test_it[a b's]"
    assert shlex.split(repeating(test, "--postgresql"))[-2:] == ["--postgresql", test]


@pytest.mark.parametrize(
    ("content", "settings", "changed"),
    [
        ({}, "", set()),
        ({"a.top": "new"}, "", {"a.top"}),
        ({"a.low": "new"}, "", {"a.top", "a.low"}),
        ({"a": "new"}, "", {"a", "a.top", "a.low", "a.alone"}),
        ({}, "strict", {"a", "a.top", "a.low", "a.alone"}),
    ],
    ids=["nothing", "what nobody imports", "what another imports", "their package", "the checker"],
)
def test_types_are_checked_again_where_an_answer_may_differ(content: dict[str, str], settings: str, changed: set[str]):
    modules, imported = dict.fromkeys(("a", "a.top", "a.low", "a.alone"), "old"), {"a.top": {"a.low"}}
    before, now = keys(modules, imported, ""), keys(modules | content, imported, settings)
    assert {name for name in modules if now[name] != before[name]} == changed


def test_the_checker_is_asked_of_every_module() -> None:
    """The packages are links in `stimrig`, which it does not follow by itself."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["basedpyright"]
    assert set(imports_of("stimrig")) - set(checked(settings)) == set()
