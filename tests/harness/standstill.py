"""A machine that stands still is no fault of the code: how long it did is measured, told, and one more try is given.

The tests marked `wire` run in real time. A rig whose machine stood still for 0.3 s stops the test that it played, and
is right; the test that expected its end has then shown nothing. A process with no other work measures by how much the
machine wakes it too late. Where that was more than `LIMIT_S` within the last `RECENT_S` before a wire test failed, the
test runs once more, with everything made anew. It counts only if it passes then. The end of the output tells the first
failure and the standstill. Not excused are errors of fixtures, and more than `MOST` tests of a process.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Protocol

import pytest
from _pytest.runner import runtestprotocol

LIMIT_S = 0.1
"""An idle machine wakes a process within 0.03 s; the shortest wait that a wire test depends on is of 0.1 s."""
RECENT_S = 30.0
"""The longest of the tests judges its parts when all are over; what happened longer before explains no failure."""
MOST = 3
SLEEP_S = 0.01
ROOT = Path(__file__).parents[2]
SLOTS = 1000
TOLD = "stood_still"
PRIORITY = 20


def watch(path: str, parent: int) -> None:
    """Sleep, and write down when the machine woke this process too late: the body of the measuring process."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    number = 0
    with Path(path).open("r+b") as file, mmap.mmap(file.fileno(), 0) as slots:
        before_s = time.monotonic()
        while os.getppid() == parent:
            time.sleep(SLEEP_S)
            now_s = time.monotonic()
            if now_s - before_s - SLEEP_S > LIMIT_S / 4:
                struct.pack_into("dd", slots, 16 * (number % SLOTS), before_s, now_s)
                number += 1
            before_s = now_s


class Measures(Protocol):
    """What knows how long the machine stood still."""

    def longest_s(self, since_s: float) -> float:
        """Seconds of the longest standstill that ended after `since_s`."""
        ...


class Meter:
    """How long the machine stood still, by a process of its own."""

    def __init__(self) -> None:
        self._file = tempfile.NamedTemporaryFile(prefix="standstill-")  # noqa: SIM115
        self._file.write(bytes(16 * SLOTS))
        self._file.flush()
        self._slots = mmap.mmap(self._file.fileno(), 0)
        code = f"from tests.harness.standstill import watch; watch({self._file.name!r}, {os.getpid()})"
        self.process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdin=subprocess.DEVNULL)

    def longest_s(self, since_s: float) -> float:
        """Of the monotonic clock; a standstill of less than 0.03 s counts as none."""
        return max((end - begin for begin, end in struct.iter_unpack("dd", self._slots[:]) if end > since_s), default=0)

    def close(self) -> None:
        """End the measuring process."""
        self.process.kill()
        self.process.wait()
        self._slots.close()
        self._file.close()


class Plugin:
    """Runs wire tests under a meter."""

    def __init__(self, meter: Measures) -> None:
        self._meter = meter
        self._first: list[pytest.TestReport] = []
        self._excused = 0

    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        """Run a wire test, and once more if it failed while the machine stood still."""
        if item.get_closest_marker("wire") is None:
            return None
        first, self._first = self._first, []
        reports, stood_s = self._run(item, nextitem)
        if not first and stood_s > LIMIT_S and self._excused < MOST and _only_the_call_failed(reports):
            self._excused += 1
            self._again(item, nextitem, reports)
            return True
        if first and all(report.passed for report in reports):
            failed = next(report for report in first if report.failed)
            reports[-1].user_properties.append((TOLD, f"{item.nodeid}: {_last_line(failed)}"))
        else:
            reports = first or reports
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _again(self, item: pytest.Item, nextitem: pytest.Item | None, first: list[pytest.TestReport]) -> None:
        """Run it a second time, by all hooks: its time limit is one of them. Nothing is left of the first run."""
        self._first = first
        try:
            item.session._setupstate.teardown_exact(None)
            item._initrequest()  # pyright: ignore[reportAttributeAccessIssue]: fixtures anew
            item.ihook.pytest_runtest_protocol(item=item, nextitem=nextitem)
        except BaseException:
            for report in first:
                item.ihook.pytest_runtest_logreport(report=report)
            raise

    def _run(self, item: pytest.Item, nextitem: pytest.Item | None) -> tuple[list[pytest.TestReport], float]:
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        failed = [report for report in reports if report.failed]
        if not failed:
            return reports, 0.0
        time.sleep(5 * SLEEP_S)  # a standstill that has just ended is written down by now
        now_s = time.monotonic()
        stood_s = self._meter.longest_s(max(now_s - sum(report.duration for report in reports), now_s - RECENT_S))
        load = " ".join(f"{value:.1f}" for value in os.getloadavg())
        for report in failed:
            report.sections.append(("machine", f"stood still for {stood_s:.2f} s at most lately; load {load}"))
        return reports, stood_s


def _only_the_call_failed(reports: list[pytest.TestReport]) -> bool:
    """No fixture failed, and it was not the time limit: a test that hangs is not one that a standstill ended."""
    failed = [report for report in reports if report.failed]
    return [report.when for report in failed] == ["call"] and "Timeout (>" not in failed[0].longreprtext


def _last_line(report: pytest.TestReport) -> str:
    machine = next(text for name, text in report.sections if name == "machine")
    return f"{machine}; {' '.join(report.longreprtext.split())[-200:]}"


def pytest_sessionstart(session: pytest.Session) -> None:
    """Measure where tests run: in each worker, or in the only process there is."""
    if not session.config.getoption("numprocesses", None) or hasattr(session.config, "workerinput"):
        meter = Meter()
        session.config.add_cleanup(meter.close)
        session.config.pluginmanager.register(Plugin(meter))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which tests were run again, and why."""
    reports = [report for kind in terminalreporter.stats.values() for report in kind]
    told = [words for report in reports for name, words in getattr(report, "user_properties", ()) if name == TOLD]
    for words in told:
        terminalreporter.write_line(f"AGAIN {words}")
