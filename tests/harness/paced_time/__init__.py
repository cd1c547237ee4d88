"""A pytest plugin: the tests marked `wire` and their processes live in paced time (`paced_clock.py`)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.harness.paced_time.paced_clock import BYTES, FOR_EVER_NS, VARIABLE, PacedClock, real_ns

FOLDER = Path(__file__).parent
CLOCK = PacedClock()


class Pace:
    """A conductor and its file."""

    def __init__(self) -> None:
        self._file = tempfile.NamedTemporaryFile(prefix="paced-time-")  # noqa: SIM115
        self._file.write(bytes(BYTES))
        self._file.flush()
        self.path = self._file.name
        read, write = os.pipe()
        command = [sys.executable, str(FOLDER / "conductor.py"), self.path, str(write)]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=(write,))
        os.close(write)
        began = os.read(read, 1)
        os.close(read)
        if not began:
            raise RuntimeError("the conductor of paced time did not begin")
        CLOCK.follow(self.path)

    @property
    def environment(self) -> dict[str, str]:
        """What a child needs to join."""
        places = [str(FOLDER), *filter(None, [os.environ.get("PYTHONPATH")])]
        return {VARIABLE: self.path, "PYTHONPATH": os.pathsep.join(places)}

    @property
    def waited_s(self) -> float:
        """How long time has waited in all."""
        return CLOCK.waited_ns(real_ns()) * 1e-9

    def close(self) -> None:
        """End the conductor; for a child that still reads, real time goes on."""
        self.process.kill()
        self.process.wait()
        CLOCK.write(CLOCK.read(real_ns())[0], real_ns(), FOR_EVER_NS)
        CLOCK.let_go()
        self._file.close()


class Plugin:
    """Says in a failing test's report how the machine was."""

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._before_s = 0.0

    def pytest_runtest_logstart(self) -> None:
        """A test begins."""
        self._before_s = self._pace.waited_s

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self):
        """Add for how long time waited, and the load."""
        report = yield
        waited_s, load = self._pace.waited_s - self._before_s, " ".join(f"{value:.1f}" for value in os.getloadavg())
        report.sections.append(("machine", f"time waited {waited_s:.2f} s for a processor; load {load}"))
        return report


def pytest_configure() -> None:
    """Rule this process before the tests import what they test; it is real time until the first is on the wire."""
    CLOCK.rule()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Begin where tests run, in each worker or in the only process there is, if any of them is on the wire."""
    config = session.config
    runs_tests = not config.getoption("numprocesses", None) or hasattr(config, "workerinput")
    if runs_tests and any(item.get_closest_marker("wire") for item in session.items):
        pace = Pace()
        config.add_cleanup(pace.close)
        config.pluginmanager.register(Plugin(pace))
        os.environ.update(pace.environment)
        CLOCK.keep()
