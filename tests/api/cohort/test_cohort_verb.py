"""`stimrig cohort` as it is typed: one line for wrong input, the reports, and a scheduler that stands elsewhere."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import LocalCluster

from stimrig.api.cli import main
from stimrig.api.cli.terminal import listed
from stimrig.api.cohort import cluster
from tests.api.test_schemas import unmet
from tests.harness.cohort_records import Session, cohort, write

pytestmark = pytest.mark.slow

PATIENCE_S = 240.0
COMMAND = """
import sys, time
from stimrig.api.cohort import results
from stimrig.api.cli.main import main

add, pause_s = results.Results.add, float(sys.argv.pop())

def add_slowly(self, row):
    status = add(self, row)
    time.sleep(pause_s if self.journal.read_bytes().count(b'\\n') == 4 else 0.1)
    return status

results.Results.add = add_slowly
main(sys.argv[1:])
"""
"""After the third row it waits as long as the last word says, s."""


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Run the verb with wrong input; return its one line."""

    def run(*words: str) -> str:
        assert main.run(["cohort", *words]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and err.startswith("stimrig cohort: "), err
        assert list(tmp_path.iterdir()) == []
        return err

    return run


@pytest.fixture
def fit(tmp_path: Path) -> tuple[str, ...]:
    return "fit", str(tmp_path), "-o", str(tmp_path / "r.parquet")


def test_without_the_extra_it_says_what_to_install(
    refusal: Callable[..., str], fit: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "dask" else find(name, *more))
    assert "pip install stimrig[cohort]" in refusal(*fit)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--select", "patient == 'x'"], "no such column: patient"),
        (["--select", "__import__('os').abort()"], "--select: "),
        (["--method", "magic"], "magic"),
        (["--effects", "magic"], "magic"),
        (["--memory", "much"], "--memory much"),
        (["--memory", "1MB"], "--memory 1MB"),
        (["--map", "torque_nm"], "torque_nm"),
        (["--limit", "0"], "--limit"),
        (["--workers", "0"], "--workers"),
        (["/nowhere"], "/nowhere: no such file"),
        (["x", "-o", "x"], "x: it would replace a file of this command"),
    ],
)
def test_wrong_options_are_one_line(
    refusal: Callable[..., str], fit: tuple[str, ...], options: list[str], named: str
) -> None:
    assert named in refusal(*fit, *options)


def in_this_process(workers: int) -> Any:
    return LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0"
    )


def test_scheduler_that_is_not_there_or_has_no_workers(
    refusal: Callable[..., str], fit: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "127.0.0.1:notaport"):
        words = refusal(*fit, "--scheduler", address)
        assert address in words and "no scheduler answers" in words
    with in_this_process(0) as empty:
        words = refusal(*fit, "--scheduler", empty.scheduler_address, "--wait", "0.5")
    assert "no worker within 0.5 s" in words


def test_reports(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """One that could not be read ends the command with 1: a script goes on after an exit code 0."""
    output = str(tmp_path / "r.parquet")
    (tmp_path / "bad.h5").write_bytes(b"\x89HDF\r\n\x1a\nand nothing more")
    words = [str(write(tmp_path / "a.h5", Session())), str(tmp_path / "bad.h5"), "-o", output, "--json"]
    with in_this_process(1) as here:
        assert main.run(["cohort", "fit", *words, "--scheduler", here.scheduler_address]) == 1
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert unmet("cohort", report) == [] and (report["ok"], report["errors"]) == (1, 1)
    assert "1 of 2 records gave no result: column `error`" in err and listed(report)[0].endswith(output)


class Processes:
    """Processes of a test; they are killed at its end."""

    def __init__(self, folder: Path) -> None:
        self.output = folder / "r.parquet"
        self.stack = ExitStack()
        cohort(folder / "sessions", 5)
        self.fit = ("cohort", "fit", str(folder / "sessions"), "-o", str(self.output))

    def start(self, *words: str, out: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *words], text=True, stdout=out, stderr=out, process_group=0, cwd=self.output.parent
        )
        self.stack.callback(lambda: (process.kill(), process.wait()))
        return process

    def begin(self, *options: str, pause_s: float) -> subprocess.Popen[str]:
        """Start a run, and wait until it has three rows."""
        options = ("--workers", "1", *options)
        run = self.start("-c", COMMAND, *self.fit, *options, f"{pause_s}", out=subprocess.PIPE)
        self.until(lambda: self.rows() >= 3 or run.poll() is not None, "three rows")
        return run

    def until(self, reached: Callable[[], Any], what: str) -> None:
        ends_s = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < ends_s, what
            time.sleep(0.01)

    def rows(self) -> int:
        journal = Path(f"{self.output}.rows")
        return journal.read_bytes().count(b"\n") - 1 if journal.exists() else 0


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path)
    with started.stack:
        yield started


def group(number: int) -> list[psutil.Process]:
    """List the processes of a group that run."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == number and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def test_ctrl_c_ends_a_run_and_all_its_processes_in_one_line(processes: Processes) -> None:
    run = processes.begin(pause_s=600.0)
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does
    out, err = run.communicate(timeout=PATIENCE_S)
    (line,) = (line for line in err.splitlines() if line and "records]" not in line)  # a slow machine draws the bar
    assert (run.returncode, out) == (130, "") and "the same command goes on" in line, err
    assert processes.rows() >= 3 and not processes.output.exists()
    processes.until(lambda: not group(run.pid), "the end of its processes")


@pytest.mark.campaign
def test_scheduler_elsewhere_computes_and_when_it_goes_what_is_done_is_kept(processes: Processes) -> None:
    file = processes.output.with_name("scheduler.json")
    options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    scheduler = processes.start("-m", "distributed.cli.dask_scheduler", *options)
    processes.until(lambda: file.exists() and file.read_text().rstrip().endswith("}"), "a scheduler")
    address = json.loads(file.read_text())["address"]
    for nanny in ("--nanny", "--no-nanny"):
        processes.start("-m", "distributed.cli.dask_worker", address, "--nthreads", "1", nanny, "--no-dashboard")
    run = processes.begin("--scheduler", address, "--wait", "200", pause_s=0.1)
    scheduler.kill()
    _, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1 and err.count("\n") == 1 and "the scheduler is gone" in err, err
    assert processes.rows() >= 3
