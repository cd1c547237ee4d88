"""A machine that stands still is no fault of the code: how long it did is measured, told, and one more try is given.

The tests marked `wire` run in real time. A rig whose machine stood still for 0.3 s stops the test that it played, and
is right; the test that expected its end has then shown nothing. A process with no other work measures by how much the
machine wakes it too late. Where that was more than `LIMIT_S` during a wire test that failed, the test runs once more,
and both the first failure and the standstill are told at the end. Nothing else is run twice.
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
SLEEP_S = 0.01
ROOT = Path(__file__).parents[2]
SLOTS = 1000
TOLD = "stood_still"
PRIORITY = 20


def watch(path: str) -> None:
    """Sleep, and write down when the machine woke this process too late: the body of the measuring process."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    parent, number = os.getppid(), 0
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
        code = f"from tests.harness.standstill import watch; watch({self._file.name!r})"
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

    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        """Run a wire test, and once more if it failed while the machine stood still."""
        if item.get_closest_marker("wire") is None:
            return None
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports, stood_s = self._run(item, nextitem)
        if stood_s > LIMIT_S and any(report.failed for report in reports):
            first = next(report for report in reports if report.failed)
            item._initrequest()  # pyright: ignore[reportAttributeAccessIssue]: fixtures anew
            reports, _ = self._run(item, nextitem)
            words = f"{item.nodeid} failed while the machine stood still for {stood_s:.2f} s; {_last_line(first)}"
            reports[-1].user_properties.append((TOLD, words))
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def _run(self, item: pytest.Item, nextitem: pytest.Item | None) -> tuple[list[pytest.TestReport], float]:
        began_s = time.monotonic()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if any(report.failed for report in reports):
            time.sleep(5 * SLEEP_S)  # a standstill that has just ended is written down by now
        stood_s = self._meter.longest_s(began_s)
        for report in reports:
            if report.failed:
                load = " ".join(f"{value:.1f}" for value in os.getloadavg())
                report.sections.append(("machine", f"stood still for {stood_s:.2f} s at most; load {load}"))
        return reports, stood_s


def _last_line(report: pytest.TestReport) -> str:
    return f"{report.when}: {' '.join(report.longreprtext.split())[-200:]}"


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
