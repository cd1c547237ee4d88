"""Results on disk: whole or not there, resumable, nothing doubled, nothing lost."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stimrig.api.cohort import results as parts
from stimrig.api.cohort import table as read_tables
from stimrig.api.cohort.computing import COPY, LEFT_OUT
from stimrig.api.cohort.results import Results
from stimrig.api.cohort.sources import Entry
from stimrig.api.cohort.table import FORMAT, FORMAT_VERSION, SCHEMA, options_of, table_of
from stimrig.api.cohort.tasks import CohortError, Task

pytestmark = pytest.mark.slow

TASK = Task("fit", software="1.0")


def made(name: str, content: str | None = None, status: str = "ok", **more: Any) -> dict[str, Any]:
    sha256 = None if content == "" else hashlib.sha256((content or name).encode()).hexdigest()
    row = {"address": f"/d/{name}", "name": name, "stamp": f"s-{content or name}", "sha256": sha256, "bytes": 3}
    return {**row, "status": status, **more}


def entry(name: str, content: str | None = None) -> Entry:
    return Entry(f"/d/{name}", name, name, 3, f"s-{content or name}")


def read(output: Path) -> list[dict[str, Any]]:
    return pq.read_table(output).to_pylist()


def told(output: Path) -> list[str]:
    return sorted(f"{row['name']} {row['status']}" for row in read(output))


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "results.parquet"


def run(output: Path, *rows: dict[str, Any], join: bool = True, **more: Any) -> list[str]:
    """A run that adds these rows; what each of them was."""
    with Results(output, TASK, **more) as results:
        kinds = [results.add(row) for row in rows]
        if join:
            results.join()
    return kinds


def refused(output: Path, match: str, task: Task = TASK) -> None:
    with pytest.raises(CohortError, match=match), Results(output, task):
        pass


def test_a_run_that_was_cut_off_goes_on(output: Path) -> None:
    bad = made("b", status="error", error_kind="bad record")
    run(output, made("a"), bad, made("c", status=LEFT_OUT), join=False)
    assert not output.exists()
    with Results(output, TASK) as results:
        assert all(results.done.has_place(entry(name)) for name in "abc")
        assert not results.done.has_place(entry("a", "changed")) and not results.done.has_place(entry("d"))
        assert results.done.has_content(made("a")["sha256"]) and not results.done.has_content(made("c")["sha256"])
        results.add(made("d"))
        assert results.join() == {"ok": 2, "error": 1, "copies": 0}
    assert told(output) == ["a ok", "b error", "d ok"]
    assert not results.folder.exists()


def test_finished_results_take_in_what_is_new(output: Path) -> None:
    run(output, made("a"), made("b"))
    run(output, made("c"))
    assert told(output) == ["a ok", "b ok", "c ok"]


def test_a_run_that_did_nothing_leaves_nothing(output: Path) -> None:
    with Results(output, TASK) as results:
        assert results.folder.exists()
    assert list(output.parent.iterdir()) == []
    with Results(output, Task("diagnose", software="1.0")):
        pass


def test_a_part_that_was_half_written_counts_for_nothing(output: Path) -> None:
    with Results(output, TASK) as results:
        results.add(made("a"))
    (results.folder / "00000001.parquet.new").write_bytes(b"PAR1half")
    run(output, made("b"))
    assert told(output) == ["a ok", "b ok"]


def test_killed_between_the_join_and_the_tidying(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(parts.shutil, "rmtree", lambda *_, **__: None)
        run(output, made("a"))
    assert Path(f"{output}.parts").exists()
    run(output)
    assert told(output) == ["a ok"]


def test_a_content_counts_once_wherever_it_lies(output: Path) -> None:
    with Results(output, TASK) as results:
        assert [results.add(made(name, "x")) for name in "ab"] == ["ok", COPY]
        assert results.join()["copies"] == 1
    assert told(output) == ["a ok"]


def test_a_file_that_was_replaced_takes_its_old_row_with_it(output: Path) -> None:
    run(output, made("a", "old"), made("b", "moved"))
    assert run(output, made("a", "new"), made("b", "other"), made("c", "moved"))[-1] == COPY
    assert {row["stamp"] for row in read(output)} == {"s-new", "s-other", "s-moved"}


def test_what_failed_is_done_again_if_asked(output: Path) -> None:
    failures = (("slow", None, "timeout"), ("far", "", "unreadable"), ("bad", None, "bad record"))
    run(output, *(made(name, content, "error", error_kind=kind) for name, content, kind in failures))
    with Results(output, TASK) as results:
        assert results.done.has_place(entry("slow"))
    with Results(output, TASK, again=True) as results:
        assert not results.done.has_place(entry("slow")) and results.done.has_place(entry("bad"))
        assert [results.add(made(name)) for name in ("slow", "far")] == ["ok", "ok"]
        results.join()
    assert told(output) == ["bad error", "far ok", "slow ok"]


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (Task("diagnose", software="1.0"), "verb fit, now diagnose"),
        (Task("fit", software="2.0"), "software 1.0, now 2.0"),
        (Task("fit", effects=("fatigue",), software="1.0"), "effects none, now fatigue"),
        (Task("fit", 'rig == "R"', software="1.0"), "select none"),
    ],
)
@pytest.mark.parametrize("joined", [False, True])
def test_other_options_are_refused(output: Path, other: Task, named: str, joined: bool) -> None:
    run(output, made("a"), join=joined)
    refused(output, named, other)
    with Results(output, TASK) as results:
        assert results.done.has_place(entry("a"))


def test_two_runs_never_write_one_output(output: Path) -> None:
    with Results(output, TASK):
        refused(output, "another run")
    run(output)


def test_what_is_no_table_of_results_is_not_written_over(output: Path, tmp_path: Path) -> None:
    output.write_bytes(b"somebody's letter")
    refused(output, "no table of results")
    pq.write_table(pa.table({"a": [1]}), output)
    refused(output, "no results of a cohort")
    assert pq.read_table(output).num_rows == 1
    refused(tmp_path, "a folder")
    assert [path.name for path in tmp_path.iterdir()] == [output.name]
    (tmp_path / "file").write_bytes(b"")
    refused(tmp_path / "file" / "x.parquet", "can be written")


def test_damaged_parts_are_one_line(output: Path) -> None:
    with Results(output, TASK) as results:
        results.add(made("a"))
    part = next(results.folder.glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-20])
    refused(output, "cannot be read")
    (results.folder / "run.json").write_bytes(b"{")
    refused(output, "Remove the folder")


def test_many_rows_pass_in_groups(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "ROWS_A_PART", 7)
    monkeypatch.setattr(read_tables, "ROWS_A_GROUP", 10)
    monkeypatch.setattr(read_tables, "ROWS_AT_ONCE", 4)
    run(output, *(made(str(number % 50), status="ok" if number % 3 else LEFT_OUT) for number in range(60)))
    assert told(output) == sorted({f"{number % 50} ok" for number in range(60) if number % 3})
    assert pq.read_metadata(output).num_row_groups > 2


def test_columns_have_types_and_units(output: Path) -> None:
    row = made(
        "a", day="2026-01-31", begun_utc="2026-01-31T10:00:00+02:00", computed_utc=datetime(2026, 2, 1, tzinfo=UTC),
        parameters=[{"of": "model", "name": "damping", "value": 1.0, "sd": None, "unit": "1"}], took_s=0.5,
    )  # fmt: skip
    with Results(output, TASK) as results:
        results.add(row)
        results.join()
    table = pq.read_table(output)
    assert table.schema.field("rms_nm").metadata[b"unit"] == "N·m".encode()
    assert all(field.metadata[b"description"] for field in table.schema)
    found = table.to_pylist()[0]
    assert found["day"] == date(2026, 1, 31) and found["begun_utc"] == datetime(2026, 1, 31, 8, tzinfo=UTC)
    assert found["parameters"][0]["value"] == 1.0
    assert json.loads(table.schema.metadata[b"options"]) == TASK.document()


def test_nonsense_in_a_record_never_ends_a_run() -> None:
    table = table_of([{**made("a"), "kind": "\ud800", "begun_utc": "yesterday", "day": "garbage", "nobody": "knows"}])
    assert table.schema.equals(SCHEMA) and table["begun_utc"][0].as_py() is None
    assert table["day"][0].as_py() is None
    table = table_of(
        [made("a"), {**made("b"), "bytes": 2**70, "rate_hz": "fast", "begun_utc": {}, "effects": [{"x": 1}]}]
    )
    assert table["bytes"].to_pylist() == [3, None] and table["name"].to_pylist() == ["a", "b"]
    assert table["rate_hz"][1].as_py() is None


EMPTY = SCHEMA.empty_table()
TABLES = {
    "other-columns": (pa.table({"a": [1]}), b"{}"),
    "texts": (pa.table({name: ["x"] for name in SCHEMA.names}), b"{}"),
    "numbers": (pa.table({name: [2**62] for name in SCHEMA.names}), b"{}"),
    "deep": (EMPTY, b"[" * 100_000),
    "no-object": (EMPTY, b"[1]"),
}


@pytest.mark.parametrize("name", TABLES)
def test_it_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    table, options = TABLES[name]
    about = {b"format": FORMAT.encode(), b"format_version": FORMAT_VERSION.encode(), b"options": options}
    pq.write_table(table.replace_schema_metadata(about), tmp_path / "r.parquet")
    with pytest.raises(CohortError, match=r"r\.parquet: ") as caught:
        options_of(tmp_path / "r.parquet")
    assert "\n" not in str(caught.value)
