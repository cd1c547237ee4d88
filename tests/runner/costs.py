"""A pytest plugin: how far a lane has come, what its tests cost, and how each that failed is repeated.

With `--costs FILE` it keeps in the file what each test cost, and estimates the time left by what they cost before.
With `--plan FILE` it writes every collected test and its markers there.
"""

from __future__ import annotations

import json
import shlex
import time
from pathlib import Path
from typing import Any

import pytest

AGAIN = "again: "
"""How a line begins that is followed by a command which repeats a failed test."""
EVERY_S = 15.0
FIRST_SHARE = 0.05
"""Before so much is done, the time left is told by the run before."""


def minutes(duration_s: float) -> str:
    """As minutes and seconds."""
    return f"{round(duration_s) // 60}:{round(duration_s) % 60:02}"


def repeating(test: str, *options: str) -> str:
    """The command that runs one test alone."""
    return " ".join([".venv/bin/python -m pytest", *options, shlex.quote(test)])


class Costs:
    """What tests cost by a run before: each of them, and all together in time of the wall."""

    def __init__(self, path: Path) -> None:
        try:
            kept = json.loads(path.read_text())
        except (OSError, ValueError):
            kept = {}
        self.wall_s: float | None = kept.get("wall_s")
        self.tests: dict[str, float] = kept.get("tests", {})

    def share(self, done: set[str], tests: list[str]) -> float:
        """How much of some tests' cost is done; one that nobody knows is as dear as the mean of the others."""
        mean_s = sum(self.tests.values()) / len(self.tests) if self.tests else 1.0
        costs = [(self.tests.get(test, mean_s) + 1e-3, test in done) for test in tests]
        return sum(cost for cost, is_done in costs if is_done) / max(sum(cost for cost, _ in costs), 1e-9)


class Progress:
    """Prints a line now and then, and writes the costs at the end."""

    def __init__(self, path: Path, options: tuple[str, ...]) -> None:
        self.path, self.options, self.before = path, options, Costs(path)
        self.began_s = self.told_s = time.perf_counter()  # not the monotonic clock: tests may rule that one
        self.tests: list[str] = []
        self.costs: dict[str, float] = {}
        self.done: set[str] = set()
        self.failed: dict[str, str] = {}

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """The tests of the only process there is."""
        self.tests = self.tests or [item.nodeid for item in session.items]

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """The tests of several processes: each collects them all."""
        self.tests = list(ids)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A file that can't be imported."""
        if report.failed:
            self.fails(report.nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count it."""
        self.costs[report.nodeid] = self.costs.get(report.nodeid, 0.0) + getattr(report, "duration", 0.0)
        if report.failed:
            self.fails(report.nodeid)
        if report.when == "teardown":
            self.done.add(report.nodeid)
            if time.perf_counter() - self.told_s >= EVERY_S:
                self.told_s = time.perf_counter()
                print(self.line(self.told_s - self.began_s), flush=True)

    def fails(self, test: str) -> None:
        """Say at once what has failed."""
        if test not in self.failed:
            self.failed[test] = repeating(test, *self.options)
            print(f"failed: {test}", flush=True)

    def line(self, passed_s: float) -> str:
        """How far it has come after so long."""
        share = self.before.share(self.done, self.tests)
        whole_s = self.before.wall_s if share < FIRST_SHARE else passed_s / share
        left = "" if whole_s is None else f", {minutes(max(whole_s - passed_s, 0.0))} left"
        failed = f", {len(self.failed)} failed" if self.failed else ""
        return f"{100 * share:3.0f} %, {len(self.done)} of {len(self.tests)} tests{left}{failed}"

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str] | None:
        """No letters: there are thousands of tests, and what fails is told by name."""
        told = report.when == "call" and report.outcome in ("passed", "failed") and not hasattr(report, "wasxfail")
        return (report.outcome, "", report.outcome.upper()) if told else None

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """A command for each that failed."""
        for command in self.failed.values():
            terminalreporter.write_line(AGAIN + command)

    def pytest_sessionfinish(self) -> None:
        """Keep the costs; those of tests that a broken run did not reach are kept from the run before."""
        tests = {test: self.before.tests[test] for test in self.tests if test in self.before.tests} | self.costs
        whole = len(self.done) == len(self.tests)
        wall_s = time.perf_counter() - self.began_s if whole else self.before.wall_s
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps({"wall_s": wall_s, "tests": tests}))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--costs", type=Path, metavar="FILE", help="tell progress, and keep there what each test costs")
    parser.addoption("--plan", type=Path, metavar="FILE", help="write every collected test and its markers there")


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--costs")
    if path is not None and not hasattr(config, "workerinput"):
        options = ("--postgresql",) if config.getoption("--postgresql", default=False) else ()
        config.pluginmanager.register(Progress(path, options))


def pytest_collection_finish(session: pytest.Session) -> None:
    path = session.config.getoption("--plan")
    if path is not None:
        path.write_text(
            json.dumps({item.nodeid: [mark.name for mark in item.iter_markers()] for item in session.items})
        )
