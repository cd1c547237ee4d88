"""A whole run on Dask in this process: a mixed folder, a bounded number in flight, cut off and resumed."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pyarrow.parquet as pq
import pytest
from distributed import Client, LocalCluster
from distributed.scheduler import KilledWorker

from stimrig.api.cohort import computing, run
from stimrig.api.cohort.cluster import check_versions
from stimrig.api.cohort.computing import close_all
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.run import AHEAD, LARGEST_PARCEL, Parcels, Run
from stimrig.api.cohort.select import Selection
from stimrig.api.cohort.sources import Entry, Source, sources_of
from stimrig.api.cohort.tally import Tally
from stimrig.api.cohort.tasks import CohortError, CutOffError, Task, checked
from stimrig.api.version import software_version
from tests.harness.cohort_records import broken, cohort

pytestmark = pytest.mark.slow

BOUNDS = computing.Bounds(300.0, 10**9, 500)
LANES = 2


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Two workers of one thread each, in this process; their computing processes are processes of their own."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with (
        LocalCluster(n_workers=LANES, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        yield client
        client.run(close_all)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six sessions of three people, and ten files that are no recording."""
    place = tmp_path_factory.mktemp("cohort")
    made = cohort(place, 6)
    broken(place, made[0])
    return place


def task(select: str = "") -> Task:
    return checked(Task("fit", Selection(select).text, software=software_version()))


def go(client: Client, sources: list[Source], output: Path, select: str = "", **more: Any) -> tuple[Run, Tally]:
    with Results(output, task(select)) as results:
        run = Run(client, sources, task(select), BOUNDS, results, **more)
        tally = run.go()
        results.join()
    return run, tally


def read(output: Path) -> list[dict[str, Any]]:
    return pq.read_table(output).to_pylist()


def test_a_mixed_folder_gives_a_row_for_each_file(client: Client, folder: Path, tmp_path: Path) -> None:
    done, tally = go(client, sources_of([str(folder)]), tmp_path / "r.parquet")
    rows = read(tmp_path / "r.parquet")
    assert Counter(row["status"] for row in rows) == {"ok": 6, "error": 10}
    assert (tally.ok, tally.error, tally.copies) == (6, 10, 0)
    assert done.parcels.most <= AHEAD * LANES * LARGEST_PARCEL
    for row in rows:
        assert row["software"] == software_version() and row["verb"] == "fit" and row["address"] and row["took_s"] >= 0
        if row["status"] == "error":
            assert row["error_kind"] == "bad record" and "\n" not in row["error"], row["error"]
            assert row["name"] in row["error"], "a person finds the file by it"
            assert row["fit_percent"] is None
        else:
            assert row["participant"] in ("P001", "P002", "P003") and row["fit_percent"] > 50
            assert {entry["unit"] for entry in row["parameters"]} >= {"µs", "N·m", "s"}


def test_a_selection_leaves_the_others_out(client: Client, folder: Path, tmp_path: Path) -> None:
    select = 'participant == "P002" and day < "2026-01-12" and "session" in name'
    _, tally = go(client, sources_of([str(folder)]), tmp_path / "r.parquet", select)
    rows = read(tmp_path / "r.parquet")
    assert [str(row["day"]) for row in rows] == ["2026-01-05"]
    assert tally.left_out == 5, "the broken ones' names say enough"


def test_a_run_that_is_interrupted_goes_on_where_it_was(client: Client, folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "r.parquet"

    def enough(tally: Tally) -> None:
        if tally.now == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go(client, sources_of([str(folder)]), output, tell=enough)
    assert not output.exists()
    _, tally = go(client, sources_of([str(folder)]), output)
    assert (tally.before, tally.now) == (9, 7)
    names = [row["name"] for row in read(output)]
    assert len(names) == len(set(names)) == 16
    _, tally = go(client, sources_of([str(folder)]), output)
    assert (tally.before, tally.now) == (16, 0)
    assert len(read(output)) == 16


def test_a_cohort_that_moved_is_not_computed_again(client: Client, tmp_path: Path) -> None:
    cohort(tmp_path / "a", 2)
    go(client, sources_of([str(tmp_path / "a")]), tmp_path / "r.parquet")
    (tmp_path / "a").rename(tmp_path / "b")
    cohort(tmp_path / "b", 3)
    _, tally = go(client, sources_of([str(tmp_path / "b")]), tmp_path / "r.parquet")
    assert (tally.copies, tally.ok) == (2, 1)
    assert len(read(tmp_path / "r.parquet")) == 3


def test_a_bucket_is_computed_as_a_folder_is(client: Client, folder: Path, tmp_path: Path, s3: Any) -> None:
    s3.mkdir("cohort")
    for name in ("P001/session-00000.h5", "P002/session-00001.h5", "half.h5"):
        s3.pipe(f"cohort/{name}", (folder / name).read_bytes())
    for _ in range(2):
        _, tally = go(client, sources_of(["s3://cohort"]), tmp_path / "r.parquet")
    assert (tally.before, tally.now) == (3, 0)
    rows = {row["address"]: row["status"] for row in read(tmp_path / "r.parquet")}
    assert rows == {
        "s3://cohort/P001/session-00000.h5": "ok",
        "s3://cohort/P002/session-00001.h5": "ok",
        "s3://cohort/half.h5": "error",
    }


class Endless:
    """A source of which nobody may want more at once than fits."""

    def __init__(self, count: int) -> None:
        self.count, self.listed, self.peak = count, 0, 0

    def check(self) -> None:
        pass

    def entries(self) -> Iterator[Entry]:
        counting = threading.current_thread() is not threading.main_thread()
        for number in range(self.count):
            if not counting:
                self.listed += 1
            yield Entry(
                f"endless:{number}", f"{number}.csv", str(number), stamp=str(number), known={"name": str(number)}
            )

    def open(self, _entry: Entry, _most_bytes: int) -> bytes:
        raise computing.SourceError("it is not there")


def test_a_long_list_is_never_held_at_once(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PARCEL_S", 60.0)  # however busy the machine is
    source = Endless(300)
    ahead: list[int] = []
    done, tally = go(client, [source], tmp_path / "r.parquet", tell=lambda one: ahead.append(source.listed - one.now))
    assert tally.error == 300 and {row["error_kind"] for row in read(tmp_path / "r.parquet")} == {"unreadable"}
    assert max(done.parcels.most, *ahead) <= AHEAD * LANES * LARGEST_PARCEL
    assert max(ahead) > AHEAD * LANES, "records that come back at once travel together"


def test_long_records_travel_alone(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PARCEL_S", 0.0)
    done, tally = go(client, [Endless(30)], tmp_path / "r.parquet")
    assert done.parcels.size == 1 and tally.error == 30 and len(read(tmp_path / "r.parquet")) == 30


def sent(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The keys of the records of each parcel, as they are sent."""
    parcels: list[list[str]] = []
    send = Parcels.send

    def noted(self: Parcels, records: list[computing.Record], tries: int = 1) -> None:
        parcels.append([entry.key for _, entry, _ in records])
        send(self, records, tries)

    monkeypatch.setattr(Parcels, "send", noted)
    return parcels


def test_what_was_not_begun_is_sent_again(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parcels = sent(monkeypatch)

    def impatient(records: list[Any], task: Task, bounds: computing.Bounds, _patience_s: float) -> computing.Done:
        return computing.run_parcel(records, task, bounds, 0.0 if len(records) > 3 else 60.0)

    monkeypatch.setattr(run, "run_parcel", impatient)
    monkeypatch.setattr(run, "PARCEL_S", 60.0)
    _, tally = go(client, [Endless(100)], tmp_path / "r.parquet")
    names = [row["name"] for row in read(tmp_path / "r.parquet")]
    assert (
        max(map(len, parcels)) > 3
        and tally.error == 100
        and sorted(names, key=int) == [str(number) for number in range(100)]
    )


def test_of_a_parcel_with_which_workers_are_lost_only_the_culprit_is(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parcels = sent(monkeypatch)

    def deadly(records: list[Any], *more: Any) -> computing.Done:
        if any(entry.key == "17" for _, entry, _ in records):
            raise KilledWorker("it", SimpleNamespace(address="tcp://gone"), 0)  # pyright: ignore[reportArgumentType]
        return computing.run_parcel(records, *more)

    monkeypatch.setattr(run, "run_parcel", deadly)
    monkeypatch.setattr(run, "PARCEL_S", 60.0)
    go(client, [Endless(40)], tmp_path / "r.parquet")
    kinds = {row["name"]: row["error_kind"] for row in read(tmp_path / "r.parquet")}
    assert len(kinds) == 40 and [name for name, kind in kinds.items() if kind == "killed"] == ["17"]
    with_it = [names for names in parcels if "17" in names]
    assert len(with_it[0]) > 1 and with_it[-1] == ["17"]


def test_a_place_that_goes_while_it_is_listed_ends_the_run_and_keeps_what_is_done(
    client: Client, folder: Path, tmp_path: Path
) -> None:
    class Gone(Endless):
        def entries(self) -> Iterator[Entry]:
            yield from super().entries()
            raise CohortError("bucket: gone")

    with pytest.raises(CohortError, match="gone"):
        go(client, [Gone(20)], tmp_path / "r.parquet")
    with Results(tmp_path / "r.parquet", task()) as results:
        assert len(results.done.places) > 0


def test_a_worker_of_another_version_ends_the_run(
    client: Client, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computing, "software_version", lambda: "9.9")
    with pytest.raises(CohortError, match=r"a worker has stimrig 9\.9"):
        go(client, sources_of([str(folder)]), tmp_path / "r.parquet")


def test_versions_are_compared_before_the_first_record(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    check_versions(client)
    monkeypatch.setattr("stimrig.api.cohort.cluster.software_version", lambda: "9.9")
    with pytest.raises(CohortError, match=r"stimrig .*, here 9\.9"):
        check_versions(client)


def test_a_worker_that_cannot_compute_ends_the_run(
    client: Client, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "run_parcel", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(CutOffError, match="No space left"):
        go(client, sources_of([str(folder)]), tmp_path / "r.parquet")
