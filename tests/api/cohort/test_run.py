"""A whole run on Dask in this process: each record costs its own row, a run that was interrupted resumes."""

from __future__ import annotations

import logging
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pyarrow.parquet as pq
import pytest
from distributed import Client, LocalCluster
from distributed.scheduler import KilledWorker

from stimrig import identify
from stimrig.api.cohort import run, worker
from stimrig.api.cohort.errors import CohortError, InterruptedRunError
from stimrig.api.cohort.record import LEFT_OUT, compute_row
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.run import DONE_BEFORE, IN_FLIGHT, run_records
from stimrig.api.cohort.sources import Entry, list_records
from stimrig.api.cohort.task import Task
from stimrig.api.cohort.worker import Bounds, record_row
from stimrig.api.jobs import process
from stimrig.api.version import software_version
from tests.harness import few_effects
from tests.harness.cohort_records import Session, broken, cohort, write

pytestmark = pytest.mark.slow

PATIENT = Bounds(limit_s=300.0)
THREADS = 2


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Two workers in this process; the processes that compute are processes of their own."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with (
        LocalCluster(n_workers=THREADS, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        yield client


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six sessions of three people, and ten files that are no recording."""
    place = tmp_path_factory.mktemp("cohort")
    broken(place, cohort(place, 6)[0])
    return place


def fit(select: str = "") -> Task:
    return Task("fit", select, software=software_version())


def go(client: Client, data: Path | Iterator[Entry], output: Path, select: str = "") -> Counter[str]:
    entries = list_records([str(data)]) if isinstance(data, Path) else data
    with Results(output, fit(select)) as results:
        counts = run_records(client, entries, fit(select), PATIENT, results)
        results.join()
    return counts


def read(output: Path) -> list[dict[str, Any]]:
    return pq.read_table(output).to_pylist()


def test_mixed_folder_gives_a_row_for_each_file(client: Client, folder: Path, tmp_path: Path) -> None:
    assert go(client, folder, tmp_path / "r.parquet") == {"ok": 6, "error": 10}
    rows = read(tmp_path / "r.parquet")
    assert Counter(row["status"] for row in rows) == {"ok": 6, "error": 10}
    for row in rows:
        assert row["software"] == software_version() and row["verb"] == "fit" and row["took_s"] >= 0
        if row["status"] == "error":
            assert row["error_kind"] == "bad record" and "\n" not in row["error"], row["error"]
            assert row["name"] in row["error"] and row["fit_percent"] is None
    (row,) = [row for row in rows if row["name"] == "session-00000.h5"]
    model = identify.fit(identify.read(row["address"])).to_dict()
    assert (row["participant"], str(row["day"]), row["record_id"]) == ("P001", "2026-01-05", "R-P001-0")
    assert row["kind"] == "pre-session" and row["begun_utc"].isoformat() == "2026-01-05T09:00:00+00:00"
    assert row["fit_percent"] == pytest.approx(model["fit"]["fit_percent"])
    assert row["verdict"] == model["quality"]["verdict"]
    assert row["duration_s"] == pytest.approx(22.69) and row["rate_hz"] == pytest.approx(100)
    parameters = {entry["name"]: entry for entry in row["parameters"]}
    assert parameters["time_constant_s"]["value"] == pytest.approx(model["linear"]["time_constant_s"])
    assert parameters["threshold_us"]["unit"] == "µs" and parameters["threshold_us"]["sd"] > 0
    left = client.run(lambda dask_worker: [str(path) for path in Path(dask_worker.local_directory).rglob("*.h5")])
    assert list(left.values()) == [[], []], "no recording stays in a worker's folder"
    assert go(client, folder, tmp_path / "r.parquet") == {DONE_BEFORE: 16} and len(read(tmp_path / "r.parquet")) == 16


def test_diagnosis_and_improvement_name_what_is_missing(tmp_path: Path) -> None:
    tired = write(tmp_path / "t.h5", Session(muscle=1, effect="fatigue"))
    with few_effects.only("fatigue"):
        diagnosis, improvement = (compute_row(tired, tired.name, {}, Task(verb)) for verb in ("diagnose", "improve"))
    assert diagnosis["verdict"] in ("effect_missing", "nothing_missing", "unexplained_structure")
    assert 0 <= diagnosis["probability"] <= 1 and diagnosis["fit_percent"] < diagnosis["ceiling_percent"] + 1
    effects = {entry["effect"] for entry in diagnosis["effects"]}
    assert {entry["of"] for entry in diagnosis["parameters"]} <= effects
    assert improvement["verdict"] == diagnosis["verdict"]
    assert improvement["steps"][0]["added"] is None
    assert len(improvement["steps"]) == 1 + len(improvement["effects"])


def test_selection(client: Client, folder: Path, tmp_path: Path) -> None:
    """A broken one that does not say whose it is is a row; of one the head can be read."""
    counts = go(client, folder, tmp_path / "r.parquet", 'participant = "P002" and day < "2026-01-12"')
    assert [str(row["day"]) for row in read(tmp_path / "r.parquet") if row["status"] == "ok"] == ["2026-01-05"]
    assert counts == {"ok": 1, "error": 9, LEFT_OUT: 6}


def unreadable(count: int) -> Iterator[Entry]:
    for number in range(count):
        yield Entry(f"/nowhere/{number}.csv", f"/nowhere/{number}.csv", stamp="1", known={"name": str(number)})


def test_list_is_never_held_whole(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send, sizes = client.map, list[int]()

    def counted(function: Any, batch: list[Entry], **options: Any) -> Any:
        sizes.append(len(batch))
        return send(function, batch, **options)

    monkeypatch.setattr(client, "map", counted)
    assert go(client, unreadable(300), tmp_path / "r.parquet") == {"error": 300}
    assert {row["error_kind"] for row in read(tmp_path / "r.parquet")} == {"unreadable"}
    assert max(sizes) == IN_FLIGHT * THREADS


# ---- what a record can do to the process that computes it


def crash(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def pid(*_: object) -> dict[str, Any]:
    return {"pid": os.getpid()}


@pytest.fixture
def compute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Compute a record on this thread, as a worker does."""
    monkeypatch.setattr(worker, "get_worker", lambda: SimpleNamespace(local_directory=str(tmp_path)))

    def row_of(path: Path, task: Task | None = None, **bounds: Any) -> dict[str, Any]:
        (entry,) = list_records([str(path)])
        return record_row(entry, task or fit(), replace(PATIENT, **bounds))

    return row_of


@pytest.fixture(scope="module")
def good(folder: Path) -> Path:
    return folder / "P001" / "session-00000.h5"


def test_record_that_hangs_is_ended(compute: Callable[..., dict[str, Any]], good: Path) -> None:
    row = compute(good, Task("diagnose", software=software_version()), limit_s=0.01)
    assert (row["status"], row["error_kind"]) == ("error", "timeout") and "--limit" in row["error"]
    assert compute(good)["status"] == "ok"


def test_record_that_crashes_its_process_is_a_row(
    compute: Callable[..., dict[str, Any]], good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(worker, "_row", crash)
        row = compute(good)
    assert row["error_kind"] == "killed" and "\n" not in row["error"] and row["sha256"]
    assert compute(good)["status"] == "ok"


def test_process_that_does_not_start_is_no_fault_of_the_record(
    compute: Callable[..., dict[str, Any]], good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "_begin", crash)
    with pytest.raises(BrokenProcessPool):
        compute(good, limit_s=298.0)


def test_record_beyond_the_memory_is_a_row(compute: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    rows = (b"%.4f,%d,%.3f,prbs\n" % (k / 400, 100 * (k // 200 % 2), k % 7) for k in range(400_000))
    (tmp_path / "large.csv").write_bytes(b"time_s,pulse_width_us,torque_nm,segment\n" + b"".join(rows))
    row = compute(tmp_path / "large.csv", memory_bytes=24 * 2**20)
    assert row["error_kind"] in ("out of memory", "killed") and "\n" not in row["error"], row


def test_process_is_replaced_after_some_records(
    compute: Callable[..., dict[str, Any]], good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "RECORDS_PER_PROCESS", 2)
    monkeypatch.setattr(worker, "_row", pid)
    pids = [compute(good, limit_s=299.0)["pid"] for _ in range(3)]
    assert pids[0] == pids[1] != pids[2]


# ---- what ends a run


def test_record_with_which_workers_are_lost_is_a_row(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def deadly(entry: Entry, **more: Any) -> Any:
        if entry.name == "17":
            raise KilledWorker("it", SimpleNamespace(address="tcp://gone"), 0)
        return record_row(entry, **more)

    monkeypatch.setattr(run, "record_row", deadly)
    go(client, unreadable(40), tmp_path / "r.parquet")
    kinds = {row["name"]: row["error_kind"] for row in read(tmp_path / "r.parquet")}
    assert len(kinds) == 40 and [name for name, kind in kinds.items() if kind == "killed"] == ["17"]


@pytest.mark.parametrize(
    ("module", "name", "value", "error", "says"),
    [
        (worker, "software_version", lambda: "9.9", CohortError, r"a worker has stimrig 9\.9"),
        (run, "record_row", Mock(side_effect=OSError(28, "No space left")), InterruptedRunError, "No space left"),
    ],
    ids=["another version", "cannot compute"],
)
def test_worker_that_cannot_compute_ends_the_run(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, name: str, value: Any, error: Any,
    says: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(module, name, value)
    with pytest.raises(error, match=says):
        go(client, unreadable(1), tmp_path / "r.parquet")
