"""`stimrig cohort` as it is typed: one line for wrong input; killed, interrupted, its workers killed, and whole."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from stimrig.api.cli import main
from stimrig.api.cohort import cluster
from tests.api.test_schemas import unmet
from tests.harness.cohort_records import cohort

pytestmark = pytest.mark.slow

PATIENCE_S = 240.0
SESSIONS = 30
COMMAND = """
import time
from stimrig.api.cohort import results
from stimrig.api.cli.main import main

add, results.PART_ROWS = results.Results.add, 1
results.Results.add = lambda self, row: (time.sleep(0.1), add(self, row))[1]
main()
"""
"""Every row to the disk at once, and not too fast: the test sees how far it is, and is in time to disturb."""


def refused(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 2) -> str:
    capsys.readouterr()
    assert main.run(["cohort", *arguments]) == code
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("stimrig cohort: "), err
    return err


def test_without_the_extra_it_says_what_to_install(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "dask" else known(name, *more))
    for words in (["fit", str(tmp_path), "-o", "x.parquet"], ["changed", "a", "b"], ["figures", "a", "-o", "b"]):
        assert "pip install stimrig[cohort]" in refused(capsys, *words)


def test_the_verb_loads_without_the_extra() -> None:
    code = (
        "import sys; from stimrig.api.cli.main import build; build('cohort'); "
        "print([name for name in ('dask', 'distributed', 'pyarrow', 'fsspec') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--select", "patient == 'x'"], "'patient'"),
        (["--select", "__import__('os').abort()"], "--select, character 1"),
        (["--method", "magic"], "magic"),
        (["--effects", "magic"], "magic"),
        (["--memory", "much"], "--memory much"),
        (["--memory", "1MB"], "--memory 1MB"),
        (["--map", "torque_nm"], "torque_nm"),
        (["--limit", "0"], "--limit"),
        (["--workers", "0"], "--workers"),
    ],
)
def test_wrong_options_are_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path, options: list[str], named: str):
    assert named in refused(capsys, "fit", str(tmp_path), "-o", str(tmp_path / "r.parquet"), *options)
    assert list(tmp_path.iterdir()) == []


def test_missing_data_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere")
    assert missing in refused(capsys, "fit", missing, "-o", str(tmp_path / "r.parquet"))
    assert "no such file" in refused(capsys, "changed", missing, missing)
    assert "no such file" in refused(capsys, "figures", missing, "-o", str(tmp_path / "f.html"))


def test_scheduler_that_is_not_there_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "127.0.0.1:notaport"):
        words = refused(capsys, "fit", str(tmp_path), "-o", str(tmp_path / "r.parquet"), "--scheduler", address)
        assert address in words and "no scheduler answers" in words


def test_scheduler_without_workers_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=0, processes=False, protocol="tcp", dashboard_address=None) as empty:
        words = refused(
            capsys, "fit", str(tmp_path), "-o", str(tmp_path / "r.parquet"), "--scheduler", empty.scheduler_address,
            "--wait", "0.5",
        )  # fmt: skip
    assert "no worker within 0.5 s" in words


# ---- the real thing: processes that are interrupted and killed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("sessions")
    cohort(place, SESSIONS)
    (place / "broken.h5").write_bytes(b"no recording")
    return place


def until(reached: Callable[[], Any], what: str, run: subprocess.Popen[str] | None = None) -> None:
    ends_s = time.monotonic() + PATIENCE_S
    while not reached():
        assert run is None or run.poll() is None, f"ended before {what}: {run.communicate()}"
        assert time.monotonic() < ends_s, what
        time.sleep(0.01)


def rows_in(parts: Path) -> int:
    """Rows that are on the disk."""
    return sum(pq.read_metadata(part).num_rows for part in parts.glob("[0-9]*.parquet"))


def test_reports(capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "r.parquet"
    one = str(next((folder / "P001").iterdir()))
    assert main.run(["cohort", "fit", one, "-o", str(output), "--workers", "1"]) == 0
    out = capsys.readouterr().out
    assert "1 with a result" in out and str(output) in out
    assert main.run(["cohort", "changed", str(output), str(output), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert unmet("cohort", report) == [] and report["unchanged"] == 1
    assert main.run(["cohort", "changed", str(output), str(output)]) == 0
    assert "1 records in both: 1 unchanged" in capsys.readouterr().out
    assert main.run(["cohort", "figures", str(output), "--html", str(tmp_path / "f.html"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert unmet("cohort", report) == [] and report["records"] == 1
    assert "Repeatability" in (tmp_path / "f.html").read_text()


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler of Dask as a process of its own, with two workers; its address."""
    file = tmp_path / "scheduler.json"
    here = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    main_one = subprocess.Popen([*here, *options], **quiet)
    workers = []
    try:
        until(file.exists, "a scheduler")
        until(lambda: file.read_text().rstrip().endswith("}"), "its whole file")
        address = json.loads(file.read_text())["address"]
        command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
        workers = [subprocess.Popen([*command, "--no-dashboard"], **quiet) for _ in range(2)]
        yield address, main_one
    finally:
        for process in (*workers, main_one):
            process.kill()
            process.wait()


@pytest.mark.campaign
def test_another_scheduler_computes_and_when_it_goes_what_is_done_is_kept(
    folder: Path, tmp_path: Path, scheduler: tuple[str, subprocess.Popen[bytes]]
) -> None:
    address, process = scheduler
    output = tmp_path / "r.parquet"

    def begun() -> subprocess.Popen[str]:
        words = ["cohort", "fit", str(folder), "-o", str(output), "--scheduler", address, "--wait", "200"]
        command = [sys.executable, "-c", COMMAND, *words]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    run = begun()
    until(lambda: rows_in(tmp_path / "r.parquet.parts") >= 3, "three rows", run)
    process.kill()
    _, err = run.communicate(timeout=PATIENCE_S)
    said = err.splitlines()
    assert run.returncode == 1 and len(said) == 1 and "the scheduler is gone" in said[0], err
    assert rows_in(tmp_path / "r.parquet.parts") >= 3
